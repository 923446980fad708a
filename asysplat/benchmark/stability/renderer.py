"""The renderer: Gaussians and cameras as no scene should have them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial

import torch
from torch import Tensor

from asysplat.benchmark.scenes import Scene, random_numbers
from asysplat.benchmark.stability.band import boundary_band
from asysplat.benchmark.stability.judge import Case, Comparison, Tensors, judge
from asysplat.benchmark.stability.views import Hostile, hostile_views
from asysplat.benchmark.timing import Result
from asysplat.rendering import render
from asysplat.rendering.interface import RenderSettings
from asysplat.scene import Cameras, Gaussians

AREA = "renderer"
COUNT = 240  # Gaussians, about
FIELDS = tuple(field.name for field in fields(Gaussians))
CAMERA = ("cam_to_world", "intrinsics")
Change = Callable[[Gaussians, Cameras], Gaussians]


def cases(counts: Sequence[int]) -> Iterator[Case]:
    """Yield Gaussians that are hostile, then cameras; `counts` are numbers of views."""
    for name, change in GAUSSIANS.items():
        yield Case(AREA, f"Gaussians {name}", "fp32", partial(_measure, Hostile(), change))
    for name, hostile in hostile_views(Hostile(), counts).items():
        if "photographs" not in name:  # which it does not see
            yield Case(AREA, name, "fp32", partial(_measure, hostile))
    for precision, dtype in (("bf16", torch.bfloat16), ("fp16", torch.float16)):
        measure = partial(_measure, Hostile(), dtype=dtype)
        yield Case(AREA, "inputs in half precision", precision, measure)


def _measure(
    hostile: Hostile, change: Change | None = None, dtype: torch.dtype = torch.float32
) -> Result:
    cameras = hostile.cameras()
    gaussians = gaussians_before(cameras)
    if change is not None:
        gaussians = change(gaussians, cameras)
    return compare((gaussians.to(dtype), cameras))


def compare(scene: Scene) -> Result:
    """Compare images, alphas, depths and all gradients where rounding may not decide.

    At a pixel of the band (`boundary_band`) an alpha or a transmittance is at a cut-off to within
    rounding: it counts nowhere.
    """
    gaussians, cameras = scene
    inputs = {name: getattr(gaussians, name) for name in FIELDS}
    inputs |= {name: getattr(cameras, name) for name in CAMERA}
    inside = ~boundary_band(gaussians, cameras, RenderSettings())
    size = (cameras.height, cameras.width)

    def draw(backend: str, tensors: Tensors) -> Tensors:
        moved = Cameras(tensors["intrinsics"], tensors["cam_to_world"], *size)
        out = render(Gaussians(*(tensors[name] for name in FIELDS)), moved, backend=backend)
        return {
            "image": out.image * inside[:, None],
            "alpha": out.alpha * inside,
            "depth": out.depth * inside,
        }

    share = inside.double().mean().item()
    return judge(
        Comparison(
            fast=partial(draw, "cpu"),
            exact=partial(draw, "reference"),
            inputs=inputs,
            leaves=tuple(inputs),
            note=f"at {share:.1%} of the pixels: at the others rounding decides about a cut-off",
        )
    )


def gaussians_before(cameras: Cameras) -> Gaussians:
    """Scatter COUNT Gaussians over the images of all cameras and over depths of 2 to 10.

    Their deviations are log-normal about two pixels, their opacities uniform in .05 to .95.
    """
    uniform, normal = random_numbers(0)
    views = cameras.num_views
    each = -(-COUNT // views)
    poses, focal = cameras.cam_to_world.double(), cameras.intrinsics[:, 0, 0].double()
    depths = 2 + 8 * uniform(views, each, 1)
    place = (uniform(views, each, 2) - 0.5) * cameras.width / focal[:, None, None]
    local = torch.cat((place * depths, depths), -1)
    means = (poses[:, None, :3, :3] @ local[..., None])[..., 0] + poses[:, None, :3, 3]
    sizes = 2 * depths / focal[:, None, None] * (0.6 * normal(views, each, 3)).exp()
    return Gaussians(
        means=means.flatten(0, 1),
        quats=normal(views * each, 4),
        scales=sizes.flatten(0, 1),
        opacities=0.05 + 0.9 * uniform(views * each),
        sh=0.5 * normal(views * each, 4, 3),
    ).to(torch.float32)


def _scaled(factors: Tensor | float, gaussians: Gaussians, _: Cameras) -> Gaussians:
    return replace(gaussians, scales=gaussians.scales * factors)


def _all(field: str, value: float, gaussians: Gaussians, _: Cameras) -> Gaussians:
    return replace(gaussians, **{field: torch.full_like(getattr(gaussians, field), value)})


def _behind(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Mirror half of them at the first camera, and put some into it."""
    means = gaussians.means.clone()
    means[::2] = 2 * cameras.centers[0] - means[::2]
    means[::10] = cameras.centers[0]
    return replace(gaussians, means=means)


def _far(gaussians: Gaussians, _: Cameras) -> Gaussians:
    """Move them a million times as far away, as large as before and larger."""
    return replace(gaussians, means=1e6 * gaussians.means, scales=1e6 * gaussians.scales)


def _bright(gaussians: Gaussians, _: Cameras) -> Gaussians:
    return replace(gaussians, sh=1e6 * gaussians.sh)


GAUSSIANS: dict[str, Change] = {
    "tiny": partial(_scaled, 1e-8),
    "huge": partial(_scaled, 1e4),
    "needles": partial(_scaled, torch.tensor([100.0, 1e-4, 1e-4])),
    "opaque": partial(_all, "opacities", 0.9999),
    "transparent": partial(_all, "opacities", 1e-6),
    "all in one place": lambda gaussians, cameras: replace(
        gaussians, means=gaussians.means.mean(0).expand_as(gaussians.means).clone()
    ),
    "behind and in cameras": _behind,
    "a million times as far": _far,
    "a million times as bright": _bright,
}
