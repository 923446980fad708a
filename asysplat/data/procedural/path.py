"""Hand-held camera paths, with the sway and tremble of a person.

Positions and look-at targets are in meters, z up, around the origin.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

UP = np.array([0.0, 0.0, 1.0])
AHEAD = 3.0  # meters from a camera to its target, where the target moves with it

Path = Callable[
    [np.random.Generator, int, float], tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]
]


def sway(
    rng: np.random.Generator, time: Float[np.ndarray, " T"], cycles: tuple[float, ...]
) -> Float[np.ndarray, " T"]:
    """Draw band-limited noise in about [-1, 1]: sines of the given numbers of cycles a walk."""
    phases = rng.uniform(0, 2 * np.pi, len(cycles))
    waves = np.sin(2 * np.pi * np.outer(time, cycles) + phases)
    return waves.mean(1)


def arc(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw an arc of 65 to 110 degrees at about `radius`, at eye level, looking across the middle.

    `num_frames` samples the same walk more or less finely, on all paths.
    """
    time = np.linspace(0, 1, num_frames)
    turn = np.radians(rng.uniform(65, 110)) * rng.choice([-1, 1])
    angle = rng.uniform(0, 2 * np.pi) + turn * (time + 0.06 * sway(rng, time, (1.0, 2.0)))
    distance = radius * (1 + 0.12 * sway(rng, time, (0.7, 1.6)))
    height = rng.uniform(1.3, 1.65) + 0.08 * sway(rng, time, (1.0, 2.3))
    positions = np.stack((distance * np.cos(angle), distance * np.sin(angle), height), 1)
    targets = np.stack([0.45 * sway(rng, time, (0.6, 1.7)) for _ in range(3)], 1)
    targets[:, 2] = rng.uniform(0.8, 1.2) + 0.5 * targets[:, 2]
    return positions, targets


def circle(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw a way of 120 to 270 degrees around the middle, at 0.7 to 1 times `radius`."""
    time = np.linspace(0, 1, num_frames)
    turn = np.radians(rng.uniform(120, 270)) * rng.choice([-1, 1])
    angle = rng.uniform(0, 2 * np.pi) + turn * (time + 0.03 * sway(rng, time, (1.0, 2.0)))
    distance = radius * rng.uniform(0.7, 1.0) * (1 + 0.05 * sway(rng, time, (0.7, 1.6)))
    positions = _on_ground(distance * np.array([np.cos(angle), np.sin(angle)]), rng, time)
    targets = np.stack([0.2 * sway(rng, time, (0.6, 1.7)) for _ in range(3)], 1)
    targets[:, 2] += rng.uniform(0.5, 1.0)
    return positions, targets


def above(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw a way of 90 to 270 degrees around something low, at 0.25 to 0.5 times `radius`.

    Cameras look down at it from close by, as when a thing is photographed and not a place.
    """
    time = np.linspace(0, 1, num_frames)
    turn = np.radians(rng.uniform(90, 270)) * rng.choice([-1, 1])
    angle = rng.uniform(0, 2 * np.pi) + turn * (time + 0.03 * sway(rng, time, (1.0, 2.0)))
    distance = radius * rng.uniform(0.25, 0.5) * (1 + 0.15 * sway(rng, time, (0.7, 1.6)))
    positions = _on_ground(distance * np.array([np.cos(angle), np.sin(angle)]), rng, time)
    positions[:, 2] += 0.15 * sway(rng, time, (0.6, 1.4))
    targets = np.stack([0.15 * sway(rng, time, (0.6, 1.7)) for _ in range(3)], 1)
    targets[:, 2] += rng.uniform(0.2, 0.6)
    return positions, targets


def forward(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw a walk of 0.8 to 1.8 times `radius` across the middle, looking about where it leads."""
    time = np.linspace(0, 1, num_frames)
    heading = rng.uniform(0, 2 * np.pi)
    ahead = np.array([[np.cos(heading)], [np.sin(heading)]])
    aside = np.array([[-np.sin(heading)], [np.cos(heading)]])
    along = radius * rng.uniform(0.8, 1.8) * (time - 0.5)
    positions = _on_ground(
        along * ahead + 0.1 * radius * sway(rng, time, (0.5, 1.3)) * aside, rng, time
    )
    gaze = heading + rng.uniform(-0.3, 0.3) + 0.3 * sway(rng, time, (0.5, 1.2))
    return positions, _ahead_of(positions, gaze, rng)


def pan(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw a turn by 50 to 110 degrees, nearly on the spot: the camera is at arm's length."""
    time = np.linspace(0, 1, num_frames)
    place = rng.uniform(0, 2 * np.pi)
    spot = radius * rng.uniform(0.1, 0.5) * np.array([[np.cos(place)], [np.sin(place)]])
    turn = np.radians(rng.uniform(50, 110)) * rng.choice([-1, 1])
    # The middle of the turn looks across the middle of the place.
    gaze = place + np.pi + turn * (time - 0.5 + 0.06 * sway(rng, time, (1.0, 2.0)))
    arm = rng.uniform(0.3, 0.5) + 0.05 * sway(rng, time, (0.8, 1.9))
    positions = _on_ground(spot + arm * np.array([np.cos(gaze), np.sin(gaze)]), rng, time)
    return positions, _ahead_of(positions, gaze, rng)


def _on_ground(
    places: Float[np.ndarray, "2 T"], rng: np.random.Generator, time: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T 3"]:
    """Lift places on the ground to the height of a camera held anywhere from chest to eyes."""
    return np.stack((*places, rng.uniform(1.1, 1.65) + 0.06 * sway(rng, time, (1.0, 2.3))), 1)


def _ahead_of(
    positions: Float[np.ndarray, "T 3"], gaze: Float[np.ndarray, " T"], rng: np.random.Generator
) -> Float[np.ndarray, "T 3"]:
    """Return targets in the direction `gaze` (radians, seen from above), a little downwards."""
    down = rng.uniform(0.0, 0.8)
    return positions + np.stack(
        (AHEAD * np.cos(gaze), AHEAD * np.sin(gaze), np.full_like(gaze, -down)), 1
    )


def look_at(
    positions: Float[np.ndarray, "T 3"],
    targets: Float[np.ndarray, "T 3"],
    rolls: Float[np.ndarray, " T"],
) -> Float[np.ndarray, "T 4 4"]:
    """Return OpenCV camera-to-world matrices; a roll (radians) turns a camera about its axis."""
    forward = targets - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    cos, sin = np.cos(rolls)[:, None], np.sin(rolls)[:, None]
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    matrices[:, :3, 0] = cos * right + sin * down
    matrices[:, :3, 1] = cos * down - sin * right
    matrices[:, :3, 2] = forward
    matrices[:, :3, 3] = positions
    return matrices


def hand_held_path(
    rng: np.random.Generator, num_frames: int, radius: float, path: Path = arc
) -> Float[np.ndarray, "T 4 4"]:
    """Draw the camera-to-world matrices of a path, with tremble and a slight roll."""
    time = np.linspace(0, 1, num_frames)
    positions, targets = path(rng, num_frames, radius)
    tremble = np.stack([0.01 * sway(rng, time, (7.0, 11.0)) for _ in range(3)], 1)
    rolls = 0.035 * sway(rng, time, (1.3, 3.1))
    return look_at(positions + tremble, targets, rolls)
