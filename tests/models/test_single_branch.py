"""Models of one branch: token merging, and a Gaussian for every pixel."""

import pytest
import torch

from asysplat.evaluation.static_cost import blank_views
from asysplat.models.stage import TokenMerge

TINY = ["width=0.125", "state_size=8"]


def test_merge_takes_a_place_and_its_three_neighbours():
    merge = TokenMerge(2)
    tokens = torch.randn(1, 3, 4, 6, 2)
    merged = merge(tokens)
    assert merged.shape == (1, 3, 2, 3, 2)
    weight, bias = merge.conv.weight[:, 0], merge.conv.bias
    patch = tokens[0, 1, 2:4, 4:6]  # becomes place (1, 2) of view 1
    expected = torch.einsum("hwd,dhw->d", patch, weight) + bias
    torch.testing.assert_close(merged[0, 1, 1, 2], expected)


@pytest.mark.parametrize(("model", "patch"), [("single_branch", 8), ("longlrm", 16)])
def test_a_gaussian_for_every_pixel(build, model, patch):
    net = build(*TINY, f"model={model}")
    assert net.patch == patch
    views = blank_views(2, 32, 64).map(torch.zeros_like)
    views.cameras.intrinsics[..., :, :] = torch.tensor([[50.0, 0, 32], [0, 50, 16], [0, 0, 1]])
    views.cameras.cam_to_world[..., :, :] = torch.eye(4)
    gaussians = net(views).validate()
    assert gaussians.num_gaussians == 2 * 32 * 64
    # One stands on the ray through each pixel's centre.
    first = gaussians.means[0, 0]
    torch.testing.assert_close(
        first[:2] / first[2], torch.tensor([(0.5 - 32) / 50, (0.5 - 16) / 50])
    )


def test_every_view_reaches_every_other(build):
    net = build(*TINY, "model=longlrm").eval()
    views = blank_views(2, 32, 32).map(torch.zeros_like)
    views.cameras.intrinsics[..., :, :] = torch.tensor([[50.0, 0, 16], [0, 50, 16], [0, 0, 1]])
    views.cameras.cam_to_world[..., :, :] = torch.eye(4)
    before = net(views).opacities[0, : 32 * 32]
    views.images[:, 1] = torch.rand(3, 32, 32)
    assert (net(views).opacities[0, : 32 * 32] - before).abs().max() > 0
