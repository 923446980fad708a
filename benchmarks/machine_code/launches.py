"""Launches of the GPU kernels as training and reconstruction make them, recorded instead of run."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor
from triton.runtime.jit import JITFunction

from asysplat.ops.adam.cuda import adam_step_cuda
from asysplat.ops.adam.reference import AdamSettings, Rows
from asysplat.ops.conv_silu import cuda as conv_silu
from asysplat.ops.image_loss import cuda as image_loss
from asysplat.ops.image_loss.reference import loss_weights
from asysplat.ops.plane_sweep import cuda as plane_sweep
from asysplat.ops.scan import ScanInputs
from asysplat.ops.selective_scan import cuda as selective_scan
from asysplat.ops.ssd import cuda as ssd
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

HEIGHT, WIDTH = 540, 960
TRAINING = "render, training"


class Launch(NamedTuple):
    """A kernel, the case that launches it, its number of programs, and all arguments by name."""

    kernel: JITFunction
    case: str
    programs: int
    arguments: dict[str, Any]

    @property
    def name(self) -> str:
        """Name the kernel with its operator, as both scans have a `pass_states`."""
        package = self.kernel.fn.__module__.split(".cuda")[0].split(".")[-1]
        return f"{package}.{self.kernel_name}"

    @property
    def kernel_name(self) -> str:
        """Name the kernel's function."""
        return self.kernel.fn.__name__


def record_launches(capability: int) -> list[Launch]:
    """Record the launches of all cases on a GPU of a compute capability, such as 90.

    No GPU is needed, and nothing is computed.
    """
    hopper = "asysplat.ops.ssd.cuda._compute_capability"
    with recording() as (launches, fills), patch(hopper, lambda x: divmod(capability, 10)):
        for case, run in CASES.items():
            start = len(launches)
            fills[:] = [keep_one_pair] if case.startswith("render") else []
            run()
            launches[start:] = [launch._replace(case=case) for launch in launches[start:]]
    return launches


@contextmanager
def recording() -> Iterator[tuple[list[Launch], list[Callable]]]:
    """Record launches; each also goes to the functions `fills`, which may write results."""
    launches: list[Launch] = []
    fills: list[Callable[[dict[str, Any]], None]] = []

    def run(kernel: JITFunction, *arguments: Any, grid: Any, warmup: bool, **others: Any) -> None:
        named = dict(zip(kernel.arg_names, arguments, strict=False)) | others
        programs = torch.Size(grid).numel()
        launches.append(Launch(kernel, "", programs, named))
        for fill in fills:
            fill(named)

    with (
        patch.object(JITFunction, "run", run),
        patch("asysplat.rendering.cuda.draw.INTERPRETED", True),  # takes tensors of a CPU
    ):
        yield launches, fills


def keep_one_pair(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if name in ("depths", "counts"):
            value.fill_(1)
        elif isinstance(value, Tensor) and not value.is_floating_point():
            value.fill_(0)


def _render(
    degree: int,
    views: int,
    cameras_needed: bool,
    masked: bool = False,
    num: int = 2048,
    **options,
) -> None:
    gaussians = Gaussians(
        means=torch.zeros(1, num, 3, requires_grad=True),
        quats=torch.ones(1, num, 4),
        scales=torch.ones(1, num, 3),
        opacities=torch.ones(1, num),
        sh=torch.zeros(1, num, (degree + 1) ** 2, 3, requires_grad=True),
    )
    lens = torch.tensor([[500.0, 0, WIDTH / 2], [0, 500, HEIGHT / 2], [0, 0, 1]])
    poses = torch.eye(4).repeat(1, views, 1, 1).requires_grad_(cameras_needed)
    cameras = Cameras(lens.repeat(1, views, 1, 1), poses, HEIGHT, WIDTH)
    masks = torch.ones(1, views, HEIGHT, WIDTH, dtype=torch.bool) if masked else None
    out = render(gaussians, cameras, backend="cuda", masks=masks, **options)
    sum(image.sum() for image in (out.image, out.depth) if image is not None).backward()


def _scan(
    module: Any, channels: tuple[int, ...], state: int, dtype: torch.dtype, reverse: bool = False
) -> None:
    tokens = 1024
    x, B = torch.zeros(1, tokens, *channels, dtype=dtype), torch.zeros(1, tokens, state).to(dtype)
    decays = (channels[0],) if module is ssd else (channels[0], state)
    steps, skip = torch.zeros(1, tokens, channels[0]), torch.zeros(channels[0])
    inputs = ScanInputs(x, steps, torch.zeros(decays), B, B, skip)
    y, saved = module.forward(inputs, reverse, True)
    module.backward(y, inputs, saved, reverse)


def _convolve(
    width: int, channels: int, size: int, dtype: torch.dtype, before: int, biased: bool
) -> None:
    """Convolve a slice of the channels of tokens with `width` channels."""
    tokens = torch.zeros(1, 1024, width, dtype=dtype)[..., :channels]
    weight, bias = torch.zeros(channels, size), torch.zeros(channels) if biased else None
    y = conv_silu.forward(tokens, weight, bias, before)
    conv_silu.backward(y, tokens, weight, bias, before)


def _plane_sweep(planes: int) -> None:
    views, neighbors = 2, torch.zeros(1, 2, 4, dtype=torch.int64)
    images, motions = torch.zeros(1, views, 256, 256), torch.zeros(1, views, 4, 3, 4)
    ranges = torch.ones(1, views, 2)
    costs = plane_sweep.cost_volume(images, neighbors, motions, ranges, planes)
    maps = torch.ones(1, views, 256, 256)
    edges = torch.zeros(1, views, 2, *maps.shape[-2:])
    plane_sweep.sgm(costs, maps, edges)
    plane_sweep.spread(costs[..., :9], edges)
    plane_sweep.consistency(maps, torch.ones(1, views), maps, neighbors, motions)


def _adam() -> None:
    num, rows = 2048, []
    for numbers in (1, 3, 4, 12, 48):
        arrays = (torch.zeros(num, numbers) for _ in range(4))
        counts = torch.zeros(num, dtype=torch.int32)
        rows.append(Rows(*arrays, counts, torch.zeros(numbers)))
    adam_step_cuda(rows, torch.ones(num, dtype=torch.bool), AdamSettings(0.9, 0.999, 1e-15))


def _image_loss(ssim_weight: float) -> None:
    images = torch.zeros(1, 3, HEIGHT, WIDTH)
    weights = loss_weights(HEIGHT, WIDTH, ssim_weight)
    for keep in (False, True):
        image_loss.compare_images(images, images, weights, keep)


CASES: dict[str, Callable[[], None]] = {
    TRAINING: lambda: _render(0, 4, False),
    "render, refinement": lambda: _render(1, 1, False, depth=False),
    "render, all options": lambda: _render(*(3, 4, True, True), depth="median", antialiased=True),
    "plane sweep": lambda: _plane_sweep(64),
    "selective scan, fp32": lambda: _scan(selective_scan, (512,), 16, torch.float32),
    "selective scan, bf16": lambda: _scan(selective_scan, (512,), 16, torch.bfloat16, True),
    "ssd, laptop, fp32": lambda: _scan(ssd, (7, 64), 64, torch.float32),
    "ssd, paper, fp32": lambda: _scan(ssd, (28, 64), 256, torch.float32, True),
    "ssd, paper, bf16": lambda: _scan(ssd, (28, 64), 256, torch.bfloat16),
    "ssd, paper, fp16": lambda: _scan(ssd, (28, 64), 256, torch.float16),
    "convolution, Mamba2, fp32": lambda: _convolve(4124, 2304, 4, torch.float32, 3, True),
    "convolution, Mamba2, bf16": lambda: _convolve(4124, 2304, 4, torch.bfloat16, 0, True),
    "convolution, MambaVision, bf16": lambda: _convolve(896, 448, 3, torch.bfloat16, 1, False),
    "adam": _adam,
    "image loss, L1 and SSIM": lambda: _image_loss(0.2),
    "image loss, L1": lambda: _image_loss(0.0),
}
