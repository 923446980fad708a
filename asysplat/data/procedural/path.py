"""A hand-held walk: an arc about a place of interest, with the sway and tremble of a person."""

import numpy as np
from jaxtyping import Float

UP = np.array([0.0, 0.0, 1.0])


def sway(
    rng: np.random.Generator, time: Float[np.ndarray, " T"], cycles: tuple[float, ...]
) -> Float[np.ndarray, " T"]:
    """Draw band-limited noise in about [-1, 1]: sines of the given numbers of cycles a walk."""
    phases = rng.uniform(0, 2 * np.pi, len(cycles))
    waves = np.sin(2 * np.pi * np.outer(time, cycles) + phases)
    return waves.mean(1)


def walk(
    rng: np.random.Generator, num_frames: int, radius: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Draw positions and look-at targets, in metres, z up, around the origin.

    The walker circles at about `radius` by 65 to 110 degrees, at eye level, and looks across the
    middle. `num_frames` samples the same walk more or less finely.
    """
    time = np.linspace(0, 1, num_frames)
    turn = np.radians(rng.uniform(65, 110)) * rng.choice([-1, 1])
    angle = rng.uniform(0, 2 * np.pi) + turn * (time + 0.06 * sway(rng, time, (1.0, 2.0)))
    distance = radius * (1 + 0.12 * sway(rng, time, (0.7, 1.6)))
    height = rng.uniform(1.3, 1.65) + 0.08 * sway(rng, time, (1.0, 2.3))
    positions = np.stack((distance * np.cos(angle), distance * np.sin(angle), height), 1)
    targets = np.stack([0.45 * sway(rng, time, (0.6, 1.7)) for _ in range(3)], 1)
    targets[:, 2] = rng.uniform(0.8, 1.2) + 0.5 * targets[:, 2]
    tremble = np.stack([0.01 * sway(rng, time, (7.0, 11.0)) for _ in range(3)], 1)
    return positions + tremble, targets


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
    rng: np.random.Generator, num_frames: int, radius: float
) -> Float[np.ndarray, "T 4 4"]:
    """Draw the camera-to-world matrices of a walk (see `walk`) with a slight roll."""
    positions, targets = walk(rng, num_frames, radius)
    rolls = 0.035 * sway(rng, np.linspace(0, 1, num_frames), (1.3, 3.1))
    return look_at(positions, targets, rolls)
