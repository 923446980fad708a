"""Cameras that are placed by hand, and those that are hard to make a path from."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from asysplat.data.procedural import ProceduralScene
from asysplat.scene import Cameras


def cameras_at(centers, targets=None, roll=0.0) -> Cameras:
    """Cameras in a world with z up, that look along y or at targets."""
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    forward = np.array([0.0, 1, 0]) if targets is None else np.asarray(targets) - centers
    forward = np.broadcast_to(forward, centers.shape)
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = np.stack((right, np.cross(forward, right), forward), 2)
    poses[:, :3, :3] @= Rotation.from_euler("z", roll).as_matrix()
    poses[:, :3, 3] = centers
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    return Cameras(
        intrinsics.repeat(len(centers), 1, 1), torch.tensor(poses, dtype=torch.float32), 48, 64
    )


def ring(angles, radius=2.0, height=0.5):
    angles = np.radians(angles)
    return np.stack(
        (radius * np.cos(angles), radius * np.sin(angles), np.full_like(angles, height)), 1
    )


def turned(axis, angles) -> Cameras:
    """Cameras at one place."""
    cameras = cameras_at(np.ones((len(angles), 3)))
    turns = Rotation.from_euler(axis, np.reshape(angles, (-1, 1)), degrees=True).as_matrix()
    cameras.cam_to_world[:, :3, :3] = torch.tensor(turns, dtype=torch.float32)
    return cameras


HARD = {
    "one": cameras_at([[1, 2, 3]]),
    "two": cameras_at([[0, 0, 0], [1, 0, 0]]),
    "two that face each other": cameras_at([[0, -1, 0], [0, 1, 0]], np.zeros((2, 3))),
    "three": cameras_at([[0, 0, 0], [1, 0, 0], [1, 1, 0]]),
    "one place": cameras_at(np.ones((5, 3))),
    "one place, a turn": turned("y", [0, 20, 40, 60]),
    "one place, all around": turned("y", list(range(0, 360, 30))),
    "one place, over the top": turned("x", list(range(0, 181, 30))),
    "collinear, sideways": cameras_at([[x, 0, 0] for x in range(6)]),
    "collinear, forwards": cameras_at([[0, y, 0] for y in range(6)]),
    "collinear, upwards": cameras_at([[0, 0, z] for z in range(6)]),
    "looking straight down": turned("x", [0.0]),
    "ups that cancel": cameras_at(ring([0, 180]), np.zeros((2, 3)), roll=math.pi / 2),
    "pairs at each place": cameras_at(np.repeat(ring(range(0, 90, 15)), 2, 0)),
    "rounding apart": cameras_at(100 + 1e-6 * np.random.default_rng(0).normal(size=(4, 3))),
    "outwards": cameras_at(ring(range(0, 360, 30)), 2 * ring(range(0, 360, 30), height=0.25)),
    "far from the origin": cameras_at(ring(range(0, 360, 30)) + 1e4, np.full((12, 3), 1e4)),
    "hand-held": ProceduralScene(2, 12, 16).views(list(range(0, 90, 3))).cameras,
}
