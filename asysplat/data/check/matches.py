"""Points that two frames share, and how they lie to the cameras.

They are found in the pixels alone: no pose is looked at, so that wrong poses cannot choose the
matches that judge them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from asysplat.data.sequence import ImageSequence
from asysplat.scene import Cameras

PLACES = 12  # in the sequence, at each of which one pair of frames starts
FIRST_GAP = 4  # frames between the two of a pair, at first
ENOUGH = 80  # matches of two frames that show the same place
KEPT = 200  # matches of a pair at most, so that none outweighs the others
KEYPOINTS = 2500  # in a frame, at most
RATIO = 0.8  # of the distance to the second-best match: the best must be nearer (Lowe, 2004)
CORRIDOR = 1.5  # pixels beside the epipolar lines of the pair's own fundamental matrix
PARALLAX = 2.0  # pixels: where a camera moved, a tenth of the points is farther off a homography


@dataclass(frozen=True)
class Matches:
    """Points seen in two frames each, pair of frames after pair.

    Args:
        frames: numbers of the two frames of each match.
        points: x, y in either, in pixels, the first pixel's center at +0.5.
    """

    frames: Int[Tensor, "M 2"]
    points: Float[Tensor, "M 2 2"]

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return [(first, second) for first, second in self.frames.unique_consecutive(dim=0).tolist()]

    def select(self, chosen: Bool[Tensor, " M"] | Int[Tensor, " N"] | slice) -> "Matches":
        return Matches(self.frames[chosen], self.points[chosen])

    def of(self, pair: tuple[int, int]) -> "Matches":
        return self.select((self.frames == torch.tensor(pair)).all(-1))


@dataclass(frozen=True)
class Keypoints:
    """SIFT keypoints of one image, x and y in pixels, and their descriptors."""

    points: Float32[ndarray, "K 2"]
    descriptors: Float32[ndarray, "K 128"]


def find_matches(sequence: ImageSequence, step: Callable[[], None] = lambda: None) -> Matches:
    """Match up to PLACES pairs of frames, evenly over the sequence.

    The gap between the frames of a pair is doubled as long as enough points are matched, and halved
    where too few are. Pairs between which the camera only turned say nothing about its position,
    and are left out if they are few.

    Args:
        step: called after each place.
    """
    keypoints = cache(partial(_keypoints, sequence))

    def matched(first: int, gap: int) -> Matches:
        second = first + gap if first + gap < sequence.num_frames else first - gap
        points = np.empty((0, 2, 2))
        if second >= 0:
            points = _match(keypoints(first), keypoints(second))
        return Matches(torch.tensor([[first, second]]).repeat(len(points), 1), torch.tensor(points))

    gap, pairs = FIRST_GAP, []
    starts = np.linspace(0, sequence.num_frames - 1, PLACES, endpoint=False).astype(int)
    for first in starts.tolist():
        pair = matched(first, gap)
        while len(pair) < ENOUGH and gap > 1:
            gap //= 2
            pair = matched(first, gap)
        while len(farther := matched(first, 2 * gap)) >= ENOUGH:
            gap *= 2
            pair = farther
        if len(pair) >= ENOUGH and pair.pairs[0] not in [found.pairs[0] for found in pairs]:
            pairs.append(pair)
        step()
    moved = [pair for pair in pairs if _has_moved(pair)]
    return _joined(moved if 2 * len(moved) > len(pairs) else pairs)


def _joined(pairs: list[Matches]) -> Matches:
    """Join the pairs, at most KEPT matches of each, spread over its keypoints."""
    kept = [pair.select(slice(None, None, -(-len(pair) // KEPT))) for pair in pairs]
    return Matches(
        torch.cat([torch.empty(0, 2, dtype=torch.int64), *(pair.frames for pair in kept)]),
        torch.cat([torch.empty(0, 2, 2).double(), *(pair.points for pair in kept)]),
    )


def _has_moved(pair: Matches) -> bool:
    """Tell whether the camera moved: if not, or if it saw only a plane, a homography fits all."""
    first, second = pair.points.unbind(1)
    homography, _ = cv2.findHomography(first.numpy(), second.numpy(), cv2.RANSAC, 2 * CORRIDOR)
    if homography is None:
        return True
    moved = cv2.perspectiveTransform(first[:, None].numpy(), homography)[:, 0]
    distances = np.linalg.norm(moved - second.numpy(), axis=1)
    return float(np.quantile(distances, 0.9)) > PARALLAX


def _keypoints(sequence: ImageSequence, frame: int) -> Keypoints:
    views = sequence.views([frame])
    gray = views.images[0].mean(0).numpy()
    # Stretched, since SIFT finds little in dark photographs.
    low, high = np.quantile(gray, (0.01, 0.99))
    gray = np.clip((gray - low) / max(high - low, 1e-3) * 255, 0, 255).astype(np.uint8)
    mask = None if views.masks is None else views.masks[0].numpy().astype(np.uint8)
    points, descriptors = cv2.SIFT_create(KEYPOINTS).detectAndCompute(gray, mask)
    if not points:
        return Keypoints(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    # OpenCV puts the first pixel's center at 0.
    return Keypoints(cv2.KeyPoint_convert(points) + np.float32(0.5), descriptors)


def _match(first: Keypoints, second: Keypoints) -> Float[ndarray, "M 2 2"]:
    """Find mutually best matches that lie near the epipolar lines of one fundamental matrix."""
    nothing = np.empty((0, 2, 2))
    if min(len(first.points), len(second.points)) < ENOUGH:
        return nothing
    there = cv2.BFMatcher().knnMatch(first.descriptors, second.descriptors, k=2)
    back = cv2.BFMatcher().match(second.descriptors, first.descriptors)
    best = [
        (nearest.queryIdx, nearest.trainIdx)
        for nearest, other in there
        if nearest.distance < RATIO * other.distance
        and back[nearest.trainIdx].trainIdx == nearest.queryIdx
    ]
    if len(best) < ENOUGH:
        return nothing
    here, beyond = np.array(best).T
    points = np.stack((first.points[here], second.points[beyond]), 1).astype(np.float64)
    _, inside = cv2.findFundamentalMat(*points.swapaxes(0, 1), cv2.FM_RANSAC, CORRIDOR, 0.9999)
    return nothing if inside is None else points[inside[:, 0] > 0]


def epipolar_lines(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """Compute the epipolar line of each match's point in either view, from the other view's point.

    Returns:
        a, b, c of each line: a x + b y + c is the distance of (x, y) in pixels. NaN where both
        views were taken from one place.
    """
    rotations = cameras.cam_to_world[..., :3, :3]
    centers = cameras.centers[matches.frames]
    baseline = centers[:, 1] - centers[:, 0]
    # The plane through a ray of one view and the center of the other is a line in the other view.
    normals = torch.linalg.cross(baseline[:, None].expand(-1, 2, -1), _rays(cameras, matches))
    to_pixels = torch.linalg.inv(cameras.intrinsics).mT @ rotations.mT
    lines = (to_pixels[matches.frames] @ normals.flip(1)[..., None])[..., 0]
    return lines / lines[..., :2].norm(dim=-1, keepdim=True)


def epipolar_distances(cameras: Cameras, matches: Matches) -> Float[Tensor, " M"]:
    """Measure the distances in pixels from points to their epipolar lines, the mean of both views.

    Infinite where both views were taken from one place.
    """
    lines = epipolar_lines(cameras, matches)
    residuals = (lines[..., :2] * matches.points).sum(-1) + lines[..., 2]
    return residuals.abs().mean(-1).nan_to_num(nan=torch.inf)


def triangulate(
    cameras: Cameras, matches: Matches
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, " M"]]:
    """Find where the two rays of each match pass nearest to each other.

    Returns:
        Depths along the z axes of both cameras, in scene units, and the angle between the rays, in
        degrees.
    """
    rays = _rays(cameras, matches)
    centers = cameras.centers[matches.frames]
    baseline = centers[:, 1] - centers[:, 0]
    # Normal equations of |x first - y second - baseline|.
    first, second = rays.unbind(1)
    aa, bb, ab = (first**2).sum(-1), (second**2).sum(-1), (first * second).sum(-1)
    ac, bc = (first * baseline).sum(-1), (second * baseline).sum(-1)
    cross = torch.linalg.cross(first, second).norm(dim=-1)
    depths = torch.stack((bb * ac - ab * bc, ab * ac - aa * bc), -1) / cross[:, None] ** 2
    return depths, torch.rad2deg(torch.atan2(cross, ab))


def _rays(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """Return the world-space directions through the points, with z = 1 in the camera."""
    points = torch.nn.functional.pad(matches.points, (0, 1), value=1.0)
    to_world = cameras.cam_to_world[..., :3, :3] @ torch.linalg.inv(cameras.intrinsics)
    return (to_world[matches.frames] @ points[..., None])[..., 0]
