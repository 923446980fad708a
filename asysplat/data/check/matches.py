"""Match points between pairs of images, and compare the matches with the cameras.

Matches come from the pixels alone, so that wrong poses cannot select the matches that test them.
"""

from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from rich.console import Console
from rich.progress import track
from torch import Tensor

from asysplat.data.sequence import ImageSequence
from asysplat.scene import Cameras

MAX_PAIRS = 12  # pairs of images, starting at evenly spaced images of the sequence
FIRST_GAP = 4  # images between the two of a pair, at first
MIN_MATCHES = 80  # matches of two images that show the same place, at least
MAX_MATCHES = 200  # matches kept of a pair, so that no pair outweighs the others
MAX_KEYPOINTS = 2500  # keypoints of an image
LOWE_RATIO = 0.8  # greatest distance to the best match, over the second best (Lowe, 2004)
RANSAC_THRESHOLD = 1.5  # pixels to the epipolar lines of the pair's own fundamental matrix
MIN_PARALLAX = 2.0  # pixels: if a camera moved, a tenth of the points is farther off a homography

# Positions x, y in pixels and SIFT descriptors of one image.
Keypoints = tuple[Float32[ndarray, "_ 2"], Float32[ndarray, "_ 128"]]


@dataclass(frozen=True)
class Matches:
    """Points matched between two images, one pair of images after the other."""

    indices: Int[Tensor, "M 2"]  # numbers of the two images
    points: Float[Tensor, "M 2 2"]  # x, y in both, in pixels, the first pixel's center at +0.5

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return [tuple(pair) for pair in self.indices.unique_consecutive(dim=0).tolist()]

    def select(self, index: Bool[Tensor, " M"] | Int[Tensor, " N"] | slice) -> "Matches":
        return Matches(self.indices[index], self.points[index])


def find_matches(sequence: ImageSequence, console: Console | None = None) -> Matches:
    """Match up to MAX_PAIRS pairs of images, spread evenly over the sequence.

    The gap between the images of a pair doubles while enough points match, and halves while too few
    do. Pairs without parallax, if the minority, are dropped: they do not constrain positions.
    """
    keypoints = cache(partial(_detect, sequence))

    def match_with_gap(first: int, gap: int) -> Matches:
        second = first + gap if first + gap < sequence.num_images else first - gap
        found = second >= 0
        points = _match(keypoints(first), keypoints(second)) if found else np.empty((0, 2, 2))
        return Matches(torch.tensor([[first, second]]).repeat(len(points), 1), torch.tensor(points))

    gap, pairs = FIRST_GAP, []
    starts = np.linspace(0, sequence.num_images - 1, MAX_PAIRS, endpoint=False).astype(int)
    hidden = console is None
    for first in track(
        starts.tolist(), "matching", console=console, transient=True, disable=hidden
    ):
        pair = match_with_gap(first, gap)
        while len(pair) < MIN_MATCHES and gap > 1:
            gap //= 2
            pair = match_with_gap(first, gap)
        while len(farther := match_with_gap(first, 2 * gap)) >= MIN_MATCHES:
            gap *= 2
            pair = farther
        if len(pair) >= MIN_MATCHES and pair.pairs not in [previous.pairs for previous in pairs]:
            pairs.append(pair)
    with_parallax = [pair for pair in pairs if _has_parallax(pair)]
    pairs = with_parallax if 2 * len(with_parallax) > len(pairs) else pairs
    # At most MAX_MATCHES of each, spread over its keypoints.
    limited = [pair.select(slice(None, None, -(-len(pair) // MAX_MATCHES))) for pair in pairs]
    empty = Matches(torch.empty(0, 2, dtype=torch.int64), torch.empty(0, 2, 2).double())
    return Matches(
        torch.cat([pair.indices for pair in (empty, *limited)]),
        torch.cat([pair.points for pair in (empty, *limited)]),
    )


def _has_parallax(pair: Matches) -> bool:
    """Return whether no homography fits; one does if the camera only turned or views a plane."""
    first, second = pair.points.numpy().swapaxes(0, 1)
    homography, _ = cv2.findHomography(first, second, cv2.RANSAC, 2 * RANSAC_THRESHOLD)
    if homography is None:
        return True
    warped = cv2.perspectiveTransform(first[:, None], homography)[:, 0]
    return float(np.quantile(np.linalg.norm(warped - second, axis=1), 0.9)) > MIN_PARALLAX


def _detect(sequence: ImageSequence, index: int) -> Keypoints:
    views = sequence.views([index])
    gray = views.images[0].mean(0).numpy()
    # Stretched, since SIFT finds little in dark photographs.
    low, high = np.quantile(gray, (0.01, 0.99))
    gray = np.clip((gray - low) / max(high - low, 1e-3) * 255, 0, 255).astype(np.uint8)
    mask = None if views.masks is None else views.masks[0].numpy().astype(np.uint8)
    points, descriptors = cv2.SIFT.create(MAX_KEYPOINTS).detectAndCompute(gray, mask)
    if not points:
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.float32)
    # OpenCV puts the first pixel's center at 0.
    return np.asarray(cv2.KeyPoint.convert(points), np.float32) + 0.5, descriptors


def _match(first: Keypoints, second: Keypoints) -> Float[ndarray, "M 2 2"]:
    """Match mutual nearest neighbors that agree with one fundamental matrix."""
    nothing = np.empty((0, 2, 2))
    (points, descriptors), (other_points, other_descriptors) = first, second
    if min(len(points), len(other_points)) < MIN_MATCHES:
        return nothing
    neighbors = cv2.BFMatcher().knnMatch(descriptors, other_descriptors, k=2)
    back = cv2.BFMatcher().match(other_descriptors, descriptors)
    mutual = [
        (best.queryIdx, best.trainIdx)
        for best, next_best in neighbors
        if best.distance < LOWE_RATIO * next_best.distance
        and back[best.trainIdx].trainIdx == best.queryIdx
    ]
    if len(mutual) < MIN_MATCHES:
        return nothing
    index, other_index = np.array(mutual).T
    matched = np.stack((points[index], other_points[other_index]), 1).astype(np.float64)
    _, inliers = cv2.findFundamentalMat(
        matched[:, 0], matched[:, 1], cv2.FM_RANSAC, RANSAC_THRESHOLD, 0.9999
    )
    return nothing if inliers is None else matched[inliers[:, 0] > 0]


def epipolar_lines(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """Compute the epipolar line in each view of each match, from the point in the other view.

    Of its a, b, c, a x + b y + c is the distance of (x, y) in pixels; NaN of cameras in one place.
    """
    rotations = cameras.cam_to_world[..., :3, :3]
    # The plane through a ray of one view and the center of the other is a line in the other view.
    baseline = _baseline(cameras, matches)[:, None].expand(-1, 2, -1)
    planes = torch.linalg.cross(baseline, _rays(cameras, matches))
    to_pixels = torch.linalg.inv(cameras.intrinsics).mT @ rotations.mT
    lines = (to_pixels[matches.indices] @ planes.flip(1)[..., None])[..., 0]
    return lines / lines[..., :2].norm(dim=-1, keepdim=True)


def epipolar_distances(cameras: Cameras, matches: Matches) -> Float[Tensor, " M"]:
    """Compute the mean distance of both points to their lines; inf of cameras in one place."""
    lines = epipolar_lines(cameras, matches)
    residuals = (lines[..., :2] * matches.points).sum(-1) + lines[..., 2]
    return residuals.abs().mean(-1).nan_to_num(nan=torch.inf)


def triangulate(
    cameras: Cameras, matches: Matches
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, " M"]]:
    """Return the depths of matches along both cameras' z axes, and their rays' angle in degrees."""
    baseline = _baseline(cameras, matches)
    # Normal equations of |x first - y second - baseline|.
    first, second = _rays(cameras, matches).unbind(1)
    aa, bb, ab = (first**2).sum(-1), (second**2).sum(-1), (first * second).sum(-1)
    ac, bc = (first * baseline).sum(-1), (second * baseline).sum(-1)
    cross = torch.linalg.cross(first, second).norm(dim=-1)
    depths = torch.stack((bb * ac - ab * bc, ab * ac - aa * bc), -1) / cross[:, None] ** 2
    return depths, torch.rad2deg(torch.atan2(cross, ab))


def _baseline(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 3"]:
    first, second = cameras.centers[matches.indices].unbind(1)
    return second - first


def _rays(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """Return the world-space directions through the points, with z = 1 in the camera."""
    points = torch.nn.functional.pad(matches.points, (0, 1), value=1.0)
    to_world = cameras.cam_to_world[..., :3, :3] @ torch.linalg.inv(cameras.intrinsics)
    return (to_world[matches.indices] @ points[..., None])[..., 0]
