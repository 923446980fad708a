"""The plane sweep at one size: cameras on an arc before a slanted wall with a texture."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from asysplat.benchmark.ops.cases import Case, Tensors
from asysplat.benchmark.products import Size, sweep_sizes
from asysplat.benchmark.scenes import DISTANCE, FOCAL, on_an_arc, random_numbers
from asysplat.ops import plane_sweep
from asysplat.scene import Cameras

SLANT = 0.3  # by which the wall is farther away, a unit to the right
WAVES = 20  # of each color
OPTIONS = ("stride", "planes", "neighbors")


@dataclass(frozen=True)
class SweepCase(Case):
    """A plane sweep, which has no gradients and computes in fp32 alone."""

    differentiable = False
    precisions = ("fp32",)
    backends = ("reference", "cpu", "cuda")
    name = "plane_sweep"

    def tensors(self) -> Tensors:
        """Make photographs and their cameras in float64; the same numbers at every call."""
        height, width = self.sizes["height"], self.sizes["width"]
        focal = FOCAL * width
        pinhole = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        one = Cameras(pinhole[None], torch.eye(4)[None], height, width)
        cameras = on_an_arc(one, self.sizes["views"]).to(torch.float64)
        tensors = {
            "images": _photographs(cameras),
            "intrinsics": cameras.intrinsics,
            "cam_to_world": cameras.cam_to_world,
        }
        batch = self.sizes["batch"]
        return {name: tensor.expand(batch, *tensor.shape) for name, tensor in tensors.items()}

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        """Return the inverse depths."""
        images = tensors["images"]
        cameras = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *images.shape[-2:])
        options = {name: self.sizes[name] for name in OPTIONS}
        return plane_sweep(images, cameras, **options, backend=backend).inverse_depth

    def products(self) -> list[Size]:
        """List products with as many multiplications as the sweep's costs."""
        batch, views, neighbors, planes, height, width = (
            self.sizes[side]
            for side in ("batch", "views", "neighbors", "planes", "height", "width")
        )
        return sweep_sizes(batch * views * neighbors, planes, height, width)


def _photographs(cameras: Cameras) -> Tensor:
    """Look at a wall at about DISTANCE, z = DISTANCE + SLANT x: [V, 3, H, W] in [0, 1]."""
    origins, directions = cameras.rays()
    missing = DISTANCE + SLANT * origins[..., 0] - origins[..., 2]
    along = missing / (directions[..., 2] - SLANT * directions[..., 0])
    points = (origins + along[..., None] * directions)[..., :2]
    uniform, normal = random_numbers(0)
    waves, phases = 6 * normal(3, WAVES, 2), 2 * math.pi * uniform(3, WAVES)
    angles = torch.einsum("vhwi,cni->vcnhw", points, waves) + phases[..., None, None]
    return (0.5 + 0.08 * angles.sin().sum(2)).clamp(0, 1)
