"""Photographs and cameras that no data set should have, and some that it does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from asysplat.benchmark.scenes import FOCAL, on_an_arc
from asysplat.scene import Cameras, Views

SPACING = 1000.0  # between cameras that are kilometers apart, where the unit is a meter
MANY = 8  # more views than that have half as many pixels along a side: time
PHOTOGRAPHS = ("black", "white", "one color", "noise")
POSES = ("on an arc", "all equal", "in a line", "kilometers apart", "upside down")
FOCALS = {"fisheye-like": 0.15, "wide": 0.4, "telescopic": 50.0}  # in image widths


@dataclass(frozen=True)
class Hostile:
    """What is hostile about views.

    Args:
        photographs: one of PHOTOGRAPHS.
        poses: one of POSES.
        focal: focal length, in image widths.
        count: number of views.
        side: pixels along each side.
    """

    photographs: str = "noise"
    poses: str = "on an arc"
    focal: float = FOCAL
    count: int = 4
    side: int = 32

    def views(self) -> Views:
        """Make the views [V] of a scene, float32; the same numbers at every call."""
        return Views(self.cameras(), make_photographs(self.photographs, self.count, self.side))

    def cameras(self) -> Cameras:
        """Make the cameras alone."""
        pixels, middle = self.focal * self.side, self.side / 2
        pinhole = torch.tensor([[pixels, 0, middle], [0, pixels, middle], [0, 0, 1]])
        camera = Cameras(pinhole[None], torch.eye(4)[None], self.side, self.side)
        return PLACED[self.poses](camera, self.count)


def hostile_views(base: Hostile, counts: Sequence[int] = ()) -> dict[str, Hostile]:
    """Change one thing of `base` at a time, each to all that it may be; names say to what."""
    found = {f"{name} photographs": replace(base, photographs=name) for name in PHOTOGRAPHS}
    found |= {f"poses {name}": replace(base, poses=name) for name in POSES if name != base.poses}
    found |= {f"{name} focal lengths": replace(base, focal=size) for name, size in FOCALS.items()}
    for count in counts:
        side = base.side if count <= MANY else base.side // 2
        found[f"views: {count}"] = replace(base, count=count, side=side)
    return found


def make_photographs(kind: str, count: int, side: int) -> Tensor:
    """Make photographs [count, 3, side, side] of one of PHOTOGRAPHS."""
    if kind == "noise":
        return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0))
    color = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "one color": (0.8, 0.1, 0.3)}
    return torch.tensor(color[kind])[:, None, None].expand(count, 3, side, side).clone()


def _in_a_line(camera: Cameras, count: int, spacing: float = 0.3) -> Cameras:
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3] = spacing * torch.arange(count)
    return Cameras(camera.intrinsics.expand(count, 3, 3), poses, camera.height, camera.width)


def _upside_down(camera: Cameras, count: int) -> Cameras:
    """Turn every other camera on the arc by half a turn about its axis."""
    cameras = _by_hand(camera, count)
    turn = torch.eye(4).repeat(count, 1, 1)
    turn[1::2, 0, 0] = turn[1::2, 1, 1] = -1
    return replace(cameras, cam_to_world=cameras.cam_to_world @ turn)


def _by_hand(camera: Cameras, count: int) -> Cameras:
    """Place cameras on an arc, a little off it: at equal distances rounding chooses neighbors."""
    cameras = on_an_arc(camera, count)
    poses = cameras.cam_to_world.clone()
    poses[:, :3, 3] += 0.02 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return replace(cameras, cam_to_world=poses)


PLACED: dict[str, Callable[[Cameras, int], Cameras]] = {
    "on an arc": _by_hand,
    "all equal": lambda camera, count: _in_a_line(camera, count, 0.0),
    "in a line": _in_a_line,
    "kilometers apart": lambda camera, count: _in_a_line(camera, count, SPACING),
    "upside down": _upside_down,
}
