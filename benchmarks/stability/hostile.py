"""Hostile images, cameras and Gaussians, for the suite."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from torch import Tensor

from asysplat.scene import Cameras, Gaussians, Views
from benchmarks.scenes import FOCAL, place_on_arc, random_numbers

SPACING = 1000.0  # distance between cameras that are "kilometers apart", in meters
MANY = 8  # scenes of more views have half as many pixels along a side, to save time
NUM_GAUSSIANS = 240  # rounded up to a multiple of the number of cameras
FIELDS = tuple(field.name for field in fields(Gaussians))
IMAGES = {"black": (0.0,) * 3, "white": (1.0,) * 3, "one color": (0.8, 0.1, 0.3), "noise": None}
FOCALS = {"fisheye-like": 0.15, "wide": 0.4, "telescopic": 50.0}  # in image widths


@dataclass(frozen=True)
class HostileViews:
    """The properties of a scene's views, of which one or more may be hostile."""

    images: str = "noise"  # key of IMAGES
    poses: str = "on an arc"  # key of POSES
    focal: float = FOCAL  # focal length, in image widths
    count: int = 4  # views
    side: int = 32  # pixels along each side

    def views(self) -> Views:
        """Make the views [V] in float32; the same numbers at every call."""
        return Views(self.cameras(), make_images(self.images, self.count, self.side))

    def cameras(self) -> Cameras:
        """Make the cameras [V] of these views."""
        pixels, middle = self.focal * self.side, self.side / 2
        pinhole = torch.tensor([[pixels, 0, middle], [0, pixels, middle], [0, 0, 1]])
        camera = Cameras(pinhole[None], torch.eye(4)[None], self.side, self.side)
        return POSES[self.poses](camera, self.count)


def hostile_views(counts: Sequence[int] = ()) -> dict[str, HostileViews]:
    """Return the default views with one property at a time changed to each hostile value.

    Args:
        counts: numbers of views to include.
    """
    base = HostileViews()
    cases = {f"{name} photographs": replace(base, images=name) for name in IMAGES}
    cases |= {f"poses {name}": replace(base, poses=name) for name in POSES if name != base.poses}
    cases |= {f"{name} focal lengths": replace(base, focal=size) for name, size in FOCALS.items()}
    for count in counts:
        side = base.side if count <= MANY else base.side // 2
        cases[f"views: {count}"] = replace(base, count=count, side=side)
    return cases


def make_images(kind: str, count: int, side: int) -> Tensor:
    """Make images [count, 3, side, side] of a kind in IMAGES."""
    if IMAGES[kind] is None:
        return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0))
    return torch.tensor(IMAGES[kind])[:, None, None].expand(count, 3, side, side).clone()


def _in_a_line(spacing: float, camera: Cameras, count: int) -> Cameras:
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, 0, 3] = spacing * torch.arange(count)
    return Cameras(camera.intrinsics.expand(count, 3, 3), poses, camera.height, camera.width)


def _upside_down(camera: Cameras, count: int) -> Cameras:
    cameras = _handheld(camera, count)
    turn = torch.eye(4).repeat(count, 1, 1)
    turn[1::2, 0, 0] = turn[1::2, 1, 1] = -1
    return replace(cameras, cam_to_world=cameras.cam_to_world @ turn)


def _handheld(camera: Cameras, count: int) -> Cameras:
    """Jitter cameras on an arc: if their distances were equal, rounding would choose neighbors."""
    cameras = place_on_arc(camera, count)
    poses = cameras.cam_to_world.clone()
    poses[:, :3, 3] += 0.02 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return replace(cameras, cam_to_world=poses)


POSES: dict[str, Callable[[Cameras, int], Cameras]] = {
    "on an arc": _handheld,
    "all equal": partial(_in_a_line, 0.0),
    "in a line": partial(_in_a_line, 0.3),
    "kilometers apart": partial(_in_a_line, SPACING),
    "upside down": _upside_down,
}


def scattered_gaussians(cameras: Cameras) -> Gaussians:
    """Scatter NUM_GAUSSIANS over the images of all cameras and over depths of 2 to 10.

    Their standard deviations are log-normal with a median of two pixels, their opacities uniform in
    0.05 to 0.95.
    """
    uniform, normal = random_numbers(0)
    views = cameras.num_views
    count = -(-NUM_GAUSSIANS // views)
    poses, focal = cameras.cam_to_world.double(), cameras.intrinsics[:, 0, 0].double()
    depths = 2 + 8 * uniform(views, count, 1)
    place = (uniform(views, count, 2) - 0.5) * cameras.width / focal[:, None, None]
    local = torch.cat((place * depths, depths), -1)
    means = (poses[:, None, :3, :3] @ local[..., None])[..., 0] + poses[:, None, :3, 3]
    sizes = 2 * depths / focal[:, None, None] * (0.6 * normal(views, count, 3)).exp()
    return Gaussians(
        means=means.flatten(0, 1),
        quats=normal(views * count, 4),
        scales=sizes.flatten(0, 1),
        opacities=0.05 + 0.9 * uniform(views * count),
        sh=0.5 * normal(views * count, 4, 3),
    ).to(torch.float32)


def hostile_gaussians(name: str, gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Make Gaussians hostile in the way that `name`, a key of HOSTILE_GAUSSIANS, says."""
    return replace(gaussians, **HOSTILE_GAUSSIANS[name](gaussians, cameras))


def _behind(gaussians: Gaussians, cameras: Cameras) -> dict[str, Tensor]:
    means = gaussians.means.clone()
    means[::2] = 2 * cameras.centers[0] - means[::2]
    means[::10] = cameras.centers[0]
    return {"means": means}


# Each function returns the changed fields.
HOSTILE_GAUSSIANS: dict[str, Callable[[Gaussians, Cameras], dict[str, Tensor]]] = {
    "tiny": lambda g, _: {"scales": g.scales * 1e-8},
    "huge": lambda g, _: {"scales": g.scales * 1e4},
    "needles": lambda g, _: {"scales": g.scales * torch.tensor([100.0, 1e-4, 1e-4])},
    "opaque": lambda g, _: {"opacities": torch.full_like(g.opacities, 0.9999)},
    "transparent": lambda g, _: {"opacities": torch.full_like(g.opacities, 1e-6)},
    "all in one place": lambda g, _: {"means": g.means.mean(0).expand_as(g.means).clone()},
    "behind and in cameras": _behind,
    "a million times as far": lambda g, _: {"means": 1e6 * g.means, "scales": 1e6 * g.scales},
    "a million times as bright": lambda g, _: {"sh": 1e6 * g.sh},
}
