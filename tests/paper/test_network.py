"""The drawing of a network, against the paper's numbers."""

import pytest
import torch
from hydra.utils import instantiate

from asysplat.errors import InputError
from paper.network import draw_network, list_branches


@pytest.fixture(scope="module")
def build(composed):
    def build(model):
        with torch.device("meta"):
            return instantiate(composed(f"model={model}", "scale=paper").model)

    return build


def test_the_papers_network_is_drawn_as_it_is(build):
    """Sec. 4.2: stages of 192, 512 and 896, of four Mamba2 and four sparse layers; d_f 256."""
    net = build("asysplat_4m4s")
    geometry, appearance = list_branches(net)
    assert [stage.width for stage in geometry.stages] == [192, 512, 896]
    assert [len(stage.layers) for stage in geometry.stages] == [8, 8, 8]
    assert [stage.width for stage in appearance.stages] == [256, 256, 256]
    axes, grid = draw_network(net, 32, 256, 256).axes
    texts = [text.get_text() for text in axes.texts]
    assert axes.get_title(loc="left").startswith("98.11M parameters, 90.5%")
    assert "geometry: 32 x 16 x 16 tokens of 16x16" in texts
    assert "appearance: 32 x 32 x 32 tokens of 8x8" in texts
    assert any("524,288 Gaussians" in text for text in texts)
    assert "grid 2 x 2" in grid.get_title()
    assert len({patch.get_facecolor() for patch in grid.patches}) == 4


def test_one_branch_is_drawn_without_links_and_a_cost_volume_not(build):
    net = build("longlrm")
    (branch,) = list_branches(net)
    assert [stage.width for stage in branch.stages] == [256, 1024, 1024]
    axes, grid = draw_network(net, 32, 256, 256).axes
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("2 x 2 tokens to one") == 1
    assert any("2,097,152 Gaussians" in text for text in texts)
    assert not grid.patches
    with pytest.raises(InputError, match=r"network= of a MVSplat.*such as asysplat_4m4s"):
        list_branches(build("mvsplat"))
