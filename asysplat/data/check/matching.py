"""Points that two frames share, found in their pixels alone: no pose is looked at, so that wrong
poses cannot choose the matches that judge them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from asysplat.data.capture import Capture

PLACES = 12  # of the sequence, from each of which one pair starts
FIRST_GAP = 4  # frames
ENOUGH = 80  # matches of two frames that show the same place
KEPT = 200  # matches of a pair, so that none outweighs the others
KEYPOINTS = 2500  # a frame
RATIO = 0.8  # of the distances to the best and to the second-best match
CORRIDOR = 1.5  # pixels beside the epipolar lines of the pair's own fundamental matrix
PARALLAX = 2.0  # pixels beside the best homography, of the tenth that fits it worst


@dataclass(frozen=True)
class Matches:
    """Points seen in two frames each, pair of frames after pair.

    Args:
        frames: numbers of the two frames of each match.
        points: x, y in either, in pixels, the first pixel's centre at +0.5.
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
    """SIFT of one image: where, and what it looks like there."""

    points: Float32[ndarray, "K 2"]
    words: Float32[ndarray, "K 128"]


def find_matches(capture: Capture, step: Callable[[], None] = lambda: None) -> Matches:
    """Matches of up to PLACES pairs, evenly over the sequence.

    How far apart the frames of a pair are follows the sequence: twice as far as long as enough is
    matched, half as far where it is not. Pairs between which the camera only turned tell nothing
    of its position, and are left out if they are few.

    Args:
        step: called after each of PLACES.
    """
    keypoints = cache(partial(_keypoints, capture))

    def matched(first: int, gap: int) -> Matches:
        second = first + gap if first + gap < capture.num_frames else first - gap
        points = np.empty((0, 2, 2))
        if second >= 0:
            points = _match(keypoints(first), keypoints(second))
        return Matches(torch.tensor([[first, second]]).repeat(len(points), 1), torch.tensor(points))

    gap, pairs = FIRST_GAP, []
    starts = np.linspace(0, capture.num_frames - 1, PLACES, endpoint=False).astype(int)
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
    """At most KEPT of each pair, spread over its keypoints."""
    kept = [pair.select(slice(None, None, -(-len(pair) // KEPT))) for pair in pairs]
    return Matches(
        torch.cat([torch.empty(0, 2, dtype=torch.int64), *(pair.frames for pair in kept)]),
        torch.cat([torch.empty(0, 2, 2).double(), *(pair.points for pair in kept)]),
    )


def _has_moved(pair: Matches) -> bool:
    """A camera that only turned, or that saw only a plane, leaves all points to one homography."""
    first, second = pair.points.unbind(1)
    homography, _ = cv2.findHomography(first.numpy(), second.numpy(), cv2.RANSAC, 2 * CORRIDOR)
    if homography is None:
        return True
    moved = cv2.perspectiveTransform(first[:, None].numpy(), homography)[:, 0]
    distances = np.linalg.norm(moved - second.numpy(), axis=1)
    return float(np.quantile(distances, 0.9)) > PARALLAX


def _keypoints(capture: Capture, frame: int) -> Keypoints:
    views = capture.views([frame])
    grey = views.images[0].mean(0).numpy()
    # Stretched, since SIFT finds little in dark photographs.
    low, high = np.quantile(grey, (0.01, 0.99))
    grey = np.clip((grey - low) / max(high - low, 1e-3) * 255, 0, 255).astype(np.uint8)
    mask = None if views.masks is None else views.masks[0].numpy().astype(np.uint8)
    points, words = cv2.SIFT_create(KEYPOINTS).detectAndCompute(grey, mask)
    if not points:
        return Keypoints(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    # OpenCV puts the first pixel's centre at 0.
    return Keypoints(cv2.KeyPoint_convert(points) + np.float32(0.5), words)


def _match(first: Keypoints, second: Keypoints) -> Float[ndarray, "M 2 2"]:
    """Mutually best matches that lie beside the epipolar lines of one fundamental matrix."""
    nothing = np.empty((0, 2, 2))
    if min(len(first.points), len(second.points)) < ENOUGH:
        return nothing
    there = cv2.BFMatcher().knnMatch(first.words, second.words, k=2)
    back = cv2.BFMatcher().match(second.words, first.words)
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
