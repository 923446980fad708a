"""Needles, and scenes far from the origin: the alpha against the textbook's in float32."""

import pytest
import torch
from backends import EXACT, INTERPRETED
from textbook import textbook_alphas

from asysplat.rendering import INRIA, render
from asysplat.scene import Cameras, Gaussians

COUNT, SIZE = 20 if INTERPRETED else 150, 32


def one_each(longest: float, offset: float) -> tuple[Gaussians, Cameras]:
    """Gaussians of any rotation, each alone before a camera of its own, `offset` from the origin.

    The long axis is 1 to `longest`, the others 1e-3 to 1 / (10 longest); or all are 0.1 to 0.3.
    """
    generator = torch.Generator().manual_seed(5)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    if longest:
        thinness = uniform(COUNT, 1)
        long, thin = longest**thinness, 1e-3 * (100 / longest) ** -thinness
        scales = torch.cat((long, thin, thin), -1)
    else:
        scales = 0.1 * 3 ** uniform(COUNT, 3)
    place = uniform(COUNT, 3) * torch.tensor([1, 1, 2]) + torch.tensor([-0.5, -0.5, 2])
    turn = torch.randn(COUNT, 3, 3, generator=generator, dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(turn - turn.mT)
    center = offset * (2 * uniform(COUNT, 3) - 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = rotation, center
    means = center + (rotation @ place[..., None]).squeeze(-1)
    gaussians = Gaussians(
        means=means[:, None],
        quats=torch.randn(COUNT, 1, 4, generator=generator, dtype=torch.float64),
        scales=scales[:, None],
        opacities=0.3 + 0.6 * uniform(COUNT, 1),
        sh=torch.zeros(COUNT, 1, 1, 3),
    )
    pinhole = torch.tensor([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]])
    cameras = Cameras(pinhole.repeat(COUNT, 1, 1, 1), poses[:, None], SIZE, SIZE)
    return gaussians.to(torch.float32), cameras.to(torch.float32)


@pytest.mark.parametrize(
    "longest, offset", [(1e3, 0.0), (0.0, 1e4), (1e3, 1e6)], ids=["needles", "far", "far needles"]
)
def test_alpha_is_40_times_nearer_than_by_the_textbook(fast_backend, longest, offset):
    gaussians, cameras = one_each(longest, offset)
    exact = render(gaussians.to(EXACT.dtype), cameras.to(EXACT.dtype)).alpha[:, 0]
    alpha = render(gaussians, cameras, backend=fast_backend.name).alpha[:, 0]
    naive, _ = textbook_alphas(gaussians, cameras)
    # Where one of them shows, and not within rounding of the cut-off.
    seen = (exact > 1.001 * INRIA.alpha_min) | (naive > 1.001 * INRIA.alpha_min)
    seen &= (exact == 0) | (exact > 1.001 * INRIA.alpha_min)
    assert seen.sum() > 7 * COUNT
    ours, theirs = (
        float(torch.quantile((value.double() - exact).abs()[seen], 0.99))
        for value in (alpha, naive)
    )
    assert ours * 40 <= theirs
