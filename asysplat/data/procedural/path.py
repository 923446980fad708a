"""Hand-held camera paths, with the sway and tremble of a person.

Positions and look-at targets are in meters, z up, around the origin.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

UP = np.array([0.0, 0.0, 1.0])
TARGET_DISTANCE = 3.0  # meters, of a target that moves with the camera

Times = Float[np.ndarray, " T"]  # from 0 to 1 along the path
Points = Float[np.ndarray, "T 3"]
Path = Callable[[Generator, Times, float], tuple[Points, Points]]  # positions and targets


def sway(rng: Generator, time: Times, *cycles: float) -> Times:
    """Draw band-limited noise in about [-1, 1]: sines of the given numbers of cycles a path."""
    phases = rng.uniform(0, 2 * np.pi, len(cycles))
    waves = np.sin(2 * np.pi * np.outer(time, cycles) + phases)
    return waves.mean(1)


def arc(rng: Generator, time: Times, radius: float) -> tuple[Points, Points]:
    """Draw an arc of 65 to 110 degrees at about `radius` and eye level, looking to the middle."""
    angle = _turn(rng, time, 65.0, 110.0, 0.06)
    distance = radius * (1 + 0.12 * sway(rng, time, 0.7, 1.6))
    height = rng.uniform(1.3, 1.65) + 0.08 * sway(rng, time, 1.0, 2.3)
    positions = np.stack((distance * np.cos(angle), distance * np.sin(angle), height), 1)
    targets = _near_middle(rng, time, 0.45)
    targets[:, 2] = rng.uniform(0.8, 1.2) + 0.5 * targets[:, 2]
    return positions, targets


def circle(rng: Generator, time: Times, radius: float) -> tuple[Points, Points]:
    """Draw a path of 120 to 270 degrees around the middle, at 0.7 to 1 times `radius`."""
    angle = _turn(rng, time, 120.0, 270.0, 0.03)
    distance = radius * rng.uniform(0.7, 1.0) * (1 + 0.05 * sway(rng, time, 0.7, 1.6))
    positions = _at_hand_height(rng, time, distance * _direction(angle))
    targets = _near_middle(rng, time, 0.2)
    targets[:, 2] += rng.uniform(0.5, 1.0)
    return positions, targets


def above(rng: Generator, time: Times, radius: float) -> tuple[Points, Points]:
    """Draw a path of 90 to 270 degrees around a low object, at 0.25 to 0.5 times `radius`."""
    angle = _turn(rng, time, 90.0, 270.0, 0.03)
    distance = radius * rng.uniform(0.25, 0.5) * (1 + 0.15 * sway(rng, time, 0.7, 1.6))
    positions = _at_hand_height(rng, time, distance * _direction(angle))
    positions[:, 2] += 0.15 * sway(rng, time, 0.6, 1.4)
    targets = _near_middle(rng, time, 0.15)
    targets[:, 2] += rng.uniform(0.2, 0.6)
    return positions, targets


def forward(rng: Generator, time: Times, radius: float) -> tuple[Points, Points]:
    """Draw a walk of 0.8 to 1.8 times `radius` across the middle, looking roughly ahead."""
    heading = rng.uniform(0, 2 * np.pi)
    ahead = _direction(np.array([heading]))
    aside = np.array([[-np.sin(heading)], [np.cos(heading)]])
    along = radius * rng.uniform(0.8, 1.8) * (time - 0.5)
    ground = along * ahead + 0.1 * radius * sway(rng, time, 0.5, 1.3) * aside
    positions = _at_hand_height(rng, time, ground)
    gaze = heading + rng.uniform(-0.3, 0.3) + 0.3 * sway(rng, time, 0.5, 1.2)
    return positions, _along_gaze(rng, positions, gaze)


def pan(rng: Generator, time: Times, radius: float) -> tuple[Points, Points]:
    """Draw a turn of 50 to 110 degrees nearly on the spot, with the camera at arm's length."""
    bearing = rng.uniform(0, 2 * np.pi)
    spot = radius * rng.uniform(0.1, 0.5) * _direction(np.array([bearing]))
    turn = np.radians(rng.uniform(50, 110)) * rng.choice([-1, 1])
    # The middle of the turn looks across the middle of the place.
    gaze = bearing + np.pi + turn * (time - 0.5 + 0.06 * sway(rng, time, 1.0, 2.0))
    arm = rng.uniform(0.3, 0.5) + 0.05 * sway(rng, time, 0.8, 1.9)
    positions = _at_hand_height(rng, time, spot + arm * _direction(gaze))
    return positions, _along_gaze(rng, positions, gaze)


def _turn(rng: Generator, time: Times, least: float, greatest: float, unsteadiness: float) -> Times:
    """Draw angles (radians) of a turn by `least` to `greatest` degrees from any direction."""
    turn = np.radians(rng.uniform(least, greatest)) * rng.choice([-1, 1])
    start = rng.uniform(0, 2 * np.pi)
    return start + turn * (time + unsteadiness * sway(rng, time, 1.0, 2.0))


def _direction(angle: Times) -> Float[np.ndarray, "2 T"]:
    return np.array([np.cos(angle), np.sin(angle)])


def _near_middle(rng: Generator, time: Times, amplitude: float) -> Points:
    return np.stack([amplitude * sway(rng, time, 0.6, 1.7) for _ in range(3)], 1)


def _at_hand_height(rng: Generator, time: Times, ground: Float[np.ndarray, "2 T"]) -> Points:
    return np.stack((*ground, rng.uniform(1.1, 1.65) + 0.06 * sway(rng, time, 1.0, 2.3)), 1)


def _along_gaze(rng: Generator, positions: Points, gaze: Times) -> Points:
    """Return targets in the direction `gaze` (radians, from above), a little downwards."""
    down = np.full_like(gaze, -rng.uniform(0.0, 0.8))
    return positions + np.stack((*TARGET_DISTANCE * _direction(gaze), down), 1)


def hand_held_path(
    rng: Generator, num_images: int, radius: float, path: Path = arc
) -> Float[np.ndarray, "T 4 4"]:
    """Draw OpenCV camera-to-world matrices along a path, with tremble and a slight roll."""
    time = np.linspace(0, 1, num_images)
    positions, targets = path(rng, time, radius)
    positions = positions + np.stack([0.01 * sway(rng, time, 7.0, 11.0) for _ in range(3)], 1)
    rolls = 0.035 * sway(rng, time, 1.3, 3.1)[:, None]
    forward = targets - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down, cos, sin = np.cross(forward, right), np.cos(rolls), np.sin(rolls)
    matrices = np.tile(np.eye(4), (num_images, 1, 1))
    columns = (cos * right + sin * down, cos * down - sin * right, forward, positions)
    matrices[:, :3] = np.stack(columns, -1)
    return matrices
