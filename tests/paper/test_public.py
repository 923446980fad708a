"""Published results of other methods on public scenes."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

import paper.public
from benchmarks.public.protocols import read_protocols
from paper.public import published_rows, published_sources

FILE = OmegaConf.to_container(OmegaConf.load(Path(paper.public.__file__).with_suffix(".yaml")))
PLACES = [(protocol, scene) for protocol in FILE.keys() - {"sources"} for scene in FILE[protocol]]


@pytest.mark.parametrize(("protocol", "scene"), sorted(PLACES))
def test_rows_are_in_range_and_name_their_source(protocol, scene):
    rows = published_rows(protocol, scene)
    assert len({row.method for row in rows}) == len(rows) == len(FILE[protocol][scene])
    assert [row.psnr for row in rows] == sorted((row.psnr for row in rows), reverse=True)
    for row in rows:
        assert row.source in published_sources()
        assert 10 < row.psnr < 45
        assert row.ssim is None or 0 < row.ssim < 1
        assert row.lpips is None or 0 < row.lpips < 1
        assert row.seconds is None or 60 < row.seconds < 2 * 86400
        assert (row.scenes is not None) == (scene == "mean")
    assert scene == "mean" or scene in read_protocols()[protocol].scenes


def test_a_row_is_as_published():
    (row,) = (row for row in published_rows("blender", "lego") if row.method == "3DGS")
    assert (row.psnr, row.ssim, row.lpips, row.seconds) == (35.70, 0.982, 0.019, 359)
    assert published_sources()[row.source].startswith(
        "https://nerfbaselines.github.io, read 2025-11-08: "
    )


def test_unknown_scenes_have_no_rows():
    assert published_rows("blender", "teapot") == published_rows("teapots", "lego") == []
