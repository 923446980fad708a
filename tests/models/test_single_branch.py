"""Models of one branch: token merging, and a Gaussian for every pixel."""

import pytest
import torch
from test_asysplat import make_views
from tiny import SIZE as TINY

from asysplat.models.stage import TokenMerge


@pytest.mark.parametrize(("width", "new_width", "group"), [(2, 6, 1), (4, 6, 2)])
def test_merge_combines_2_x_2_tokens(width, new_width, group):
    """As published each channel makes new ones, or else groups that divide both widths."""
    merge = TokenMerge(width, new_width)
    tokens = torch.randn(1, 3, 4, 6, width)
    merged = merge(tokens)
    assert merged.shape == (1, 3, 2, 3, new_width)
    patch = tokens[0, 1, 2:4, 4:6]  # becomes place (1, 2) of view 1
    read = torch.stack([patch[..., i : i + group] for i in range(0, width, group)])
    weights = merge.conv.weight.unflatten(0, (len(read), -1))
    expected = torch.einsum("ghwc,gochw->go", read, weights).flatten() + merge.conv.bias
    torch.testing.assert_close(merged[0, 1, 1, 2], expected)


def test_global_tokens_are_part_of_the_sequence_and_are_read(build):
    """The layers get one sequence; the global tokens change the result and are trained."""
    net = build(*TINY, "model=longlrm").eval()
    assert net.global_tokens.shape[0] == 2 and net.tokenizer.norm.bias is None
    shapes = []
    for block in (layer for stage in net.stages for layer in stage.layers):
        block.register_forward_pre_hook(lambda _, inputs: shapes.append(inputs[0].shape))
    views = make_views(batch=(1,), views=3, height=32, width=48)
    gaussians = net(views)
    assert shapes[0][1:4] == (1, 1, 2 + 3 * 4 * 6) and shapes[-1][1:4] == (1, 1, 2 + 3 * 2 * 3)
    sum(field.sum() for field in (gaussians.means, gaussians.sh, gaussians.opacities)).backward()
    assert net.global_tokens.grad.abs().sum() > 0
    with torch.no_grad():
        net.global_tokens += 1
        net.global_tokens[:, ::2] -= 3
        assert (net(views).opacities - gaussians.opacities).abs().max() > 0


@pytest.mark.parametrize(("model", "patch"), [("single_branch", 8), ("longlrm", 16)])
def test_a_gaussian_for_every_pixel(build, model, patch):
    net = build(*TINY, f"model={model}")
    assert net.patch == patch
    views = make_views(batch=(1,), views=2, height=32, width=64)
    gaussians = net(views).validate()
    assert gaussians.num_gaussians == 2 * 32 * 64
    # One stands on the ray through each pixel's center.
    first = gaussians.means[0, 0] - views.cameras.centers[0, 0]
    torch.testing.assert_close(
        first[:2] / first[2], torch.tensor([(0.5 - 32) / 50, (0.5 - 16) / 50])
    )


@pytest.mark.medium
def test_every_view_reaches_every_other(build):
    net = build(*TINY, "model=longlrm").eval()
    views = make_views(batch=(1,), views=2, height=32, width=32)
    before = net(views).opacities[0, : 32 * 32]
    views.images[:, 1] = torch.rand(3, 32, 32)
    assert (net(views).opacities[0, : 32 * 32] - before).abs().max() > 0
