"""Rows of other systems that evaluate.py measured, beside the paper's quoted numbers."""

import json
import re

import pytest

from asysplat.runs.evaluation_target import options_of_test
from paper.fill import fill_table
from paper.markdown import render_markdown
from paper.systems import find_systems
from paper.tables import load_paper

RE10K = ["data=realestate10k", "data.test_root=/a/re10k/test", "data.root=/a/re10k/train"]
TWO_VIEWS = ["experiment=two_views", "metrics=pixelsplat", *RE10K]


@pytest.fixture
def write(compose, tmp_path):
    """Write the evaluation of a system by evaluate.py with these overrides."""

    def written(system, psnr, *overrides, seed=0, **more):
        config = compose(overrides)
        name = config.data.name
        results = {"evaluation/config_hash": "", "evaluation/revision": "abc"}
        results |= {"evaluation/seed": seed, "evaluation/system": system, "tested/scenes": 12}
        tested = options_of_test(config, name)
        results |= {f"tested/{key}": value for key, value in tested.items()} | more
        results |= {f"test/{name}/post0/psnr": psnr, "protocol/name": config.metrics.name}
        folder = tmp_path / "evaluate" / f"{system}-{len(list(tmp_path.rglob('*')))}"
        folder.mkdir(parents=True)
        (folder / "evaluation.json").write_text(json.dumps(results))
        return folder

    return written


def fill(compose, tmp_path, table, *overrides):
    filled = fill_table(load_paper()[table], overrides, compose, {}, list(find_systems(tmp_path)))
    return filled, {row.name: row for row in filled.rows}


@pytest.mark.medium
def test_a_measured_system_stands_beside_its_quoted_numbers(compose, write, tmp_path):
    for seed, psnr in ((1, 24.0), (0, 25.0)):
        write("PixelSplat", psnr, *TWO_VIEWS, seed=seed)
    filled, rows = fill(compose, tmp_path, "two_views", "data=realestate10k")
    row = rows["pixelSplat"]
    assert row.values == {"realestate10k/psnr": [25.0, 24.0]} and row.seeds == (0, 1)
    assert row.numbers["realestate10k/psnr"] == 25.89
    assert row.note.startswith(
        "measured: 12 scenes of realestate10k data, 2 input views of 64x64, metrics pixelsplat, "
        "seed 0, "
    )
    assert row.note.endswith("; the paper's numbers are quoted")
    assert not rows["DepthSplat"].values and filled.metrics == ("protocol pixelsplat",)
    page = render_markdown([filled])
    (line,) = re.findall(r"\| pixelSplat \|.*", page)
    assert "25.89 | 24.50 ± 0.71 | 0.858 | quoted |" in line
    (line,) = re.findall(r"\| DepthSplat \|.*", page)
    assert "27.47 | quoted |" in line
    assert "- **Quoted**: DepthSplat" in page
    assert "- **Measured**: pixelSplat: 12 scenes of realestate10k data" in page


UNLIKE = {
    "metrics": (["metrics=default"], {}, "metrics.name=default (pixelsplat)"),
    "another folder": (["data.test_root=/a/other"], {}, "root=other (test)"),
    "another index": ([], {"tested/index": "0"}, "index=0 ("),
}


@pytest.mark.medium
@pytest.mark.parametrize("case", UNLIKE)
def test_other_options_are_not_the_tables(compose, write, tmp_path, case):
    change, more, message = UNLIKE[case]
    (tmp_path / "index.json").write_text("{}")
    index = f"data.index={tmp_path}/index.json"
    folder = write("DepthSplat", 25.0, *TWO_VIEWS, index, *change, **more)
    given = ["data=realestate10k", index, "data.test_root=/b/test"]
    _, rows = fill(compose, tmp_path, "two_views", *given)
    row = rows["DepthSplat"]
    assert not row.values and str(folder) in row.note and message in row.note
    assert row.note.startswith("measured with other options than the table's (in brackets)")


@pytest.mark.medium
def test_evaluations_on_several_sets_make_a_row(compose, write, tmp_path):
    """The 3DGS of Table 2, measured on DL3DV and on MipNeRF-360, each as a data set."""
    options = ["experiment=three_stages", "metrics=longlrm"]
    dl3dv = ["data=dl3dv", "data.root=/a/D", "data.test_root=/a/B"]
    write("3DGS", 21.0, *options, *dl3dv, **{"cost/post0/seconds": 7.0})
    write("3DGS", 20.0, *options, "data=mipnerf360", "data.root=/a/360_v2")
    _, rows = fill(compose, tmp_path, "state_of_the_art", "data=dl3dv")
    row = rows["3DGS, 30k steps"]
    assert row.values.pop("inference_seconds") == [7.0]  # seconds are those on DL3DV
    assert row.values == {"dl3dv/psnr": [21.0], "mipnerf360/psnr": [20.0]}
    assert "12 scenes of dl3dv data" in row.note and "12 scenes of mipnerf360 data" in row.note


@pytest.mark.medium
def test_input_views_tell_rows_of_one_system_apart(compose, write, tmp_path):
    options = ["experiment=three_stages", "metrics=longlrm", "data=dl3dv"]
    write("AnySplat", 13.0, *options, "data.inputs=${more_inputs}")
    _, rows = fill(compose, tmp_path, "more_views", "data=dl3dv")
    assert rows["AnySplat, 64 views"].values == {"dl3dv/psnr": [13.0]}
    assert not rows["AnySplat, 32 views"].values


@pytest.mark.medium
def test_further_systems_are_added_to_tables_that_quote_some(compose, write, tmp_path):
    write("FreeSplat", 24.0, "experiment=two_views", "metrics=pixelsplat")
    filled, rows = fill(compose, tmp_path, "two_views")
    assert rows["FreeSplat"].values == {"realestate10k/psnr": [24.0]}
    assert "quoted" not in rows["FreeSplat"].note and filled.rows[-1].name == "FreeSplat"
    assert re.search(r"\| FreeSplat \|.* - \| .*24\.00", render_markdown([filled]))
    _, rows = fill(compose, tmp_path, "state_of_the_art")  # other options
    assert "FreeSplat" not in rows
    assert len(fill(compose, tmp_path, "layers")[0].rows) == len(load_paper()["layers"].rows)
