"""The suite of published scenes: splits by hand, whole and right-sized scenes, kept results."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from asysplat.data import ProceduralScene
from asysplat.data.write import write_image, write_transforms
from asysplat.errors import InputError
from benchmarks.public import report
from benchmarks.public.protocols import SceneProtocol, open_published, read_protocols
from paper.public import PublishedRow

PROTOCOLS = read_protocols()
SMALL = SceneProtocol("small", "Small", "transforms", {"fern": (9, 24, 32)}, "default")


@pytest.fixture(scope="module")
def fern(tmp_path_factory):
    """Nine images of 24x32, in a folder that a protocol names."""
    folder = tmp_path_factory.mktemp("root") / "fern"
    views = ProceduralScene(1, 24, 32, num_images=40, places="rooms").views(range(9))
    write_transforms(replace(views, depths=None), folder)
    return folder


def test_splits_by_hand():
    """LLFF's horns: of 62 images 8 are held out; the middle of 54 is 26.5, which rounds to 26."""
    rest = [index for index in range(62) if index % 8]
    three, nine = (PROTOCOLS[f"llff_{n}_views"].inputs(rest) for n in (3, 9))
    assert three == [1, rest[26], 61] == [1, 30, 61]
    assert nine == [rest[i] for i in (0, 7, 13, 20, 26, 33, 40, 46, 53)]
    assert PROTOCOLS["llff"].inputs(rest) == rest
    bonsai = [index for index in range(292) if index % 8]
    twelve = [0, 23, 46, 69, 92, 115, 138, 161, 184, 207, 230, 254]  # 254 / 11 is 23.09
    assert PROTOCOLS["mipnerf360_12_views"].inputs(bonsai) == [bonsai[i] for i in twelve]
    lego = list(range(100))
    assert PROTOCOLS["blender_8_views"].inputs(lego) == [2, 16, 26, 55, 73, 76, 86, 93]
    assert PROTOCOLS["blender"].inputs(lego) == lego
    dtu = PROTOCOLS["dtu_6_views"]
    assert dtu.inputs([]) == [25, 22, 28, 40, 44, 48]
    left = [1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, *range(29, 36), 41, 42, 43, 45, 46, 47]
    assert dtu.held_out(list(range(49))) == PROTOCOLS["dtu_3_views"].held_out([*range(49)]) == left
    for protocol in PROTOCOLS.values():
        assert protocol.read_metrics().describe()["name"] == protocol.metrics


def test_a_scene_must_be_whole_and_of_the_size(fern):
    photographs, images = open_published(SMALL, fern, lambda _: None)
    assert images == "as they are"
    assert photographs.held_out.num_views == 2 and photographs.inputs.num_views == 7
    assert [Path(file).stem for file in photographs.held_out_files] == ["00000", "00008"]
    for changed, message in {
        (8, 24, 32): "has 9 images, and Small has 8 of this scene",
        (9, 48, 64): r"images of 24x32 \(height x width\), and Small is measured at 48x64",
        (9, 24, 24): r"images of 24x32 \(height x width\), and Small is measured at 24x24",
    }.items():
        with pytest.raises(InputError, match=message):
            open_published(replace(SMALL, scenes={"fern": changed}), fern, lambda _: None)


def test_an_object_is_measured_alone(fern, tmp_path):
    """The inputs keep what is behind it; a gray image of held-out ones is measured by hand."""
    scene = shutil.copytree(fern, tmp_path / "fern")
    masked = replace(SMALL, masked=True, metrics="dtu", views=3, indices=(1, 2, 3))
    with pytest.raises(InputError, match=r"00000\.png has no mask"):
        open_published(masked, scene, lambda _: None)
    (scene / "masks").mkdir()
    inside = np.zeros((24, 32), np.uint8)
    inside[6:18, 8:24] = 255
    for image in (scene / "images").iterdir():
        Image.fromarray(inside).save(scene / "masks" / image.name)
    photographs, _ = open_published(masked, scene, lambda _: None)
    full, _ = open_published(replace(SMALL, views=3, indices=(1, 2, 3)), fern, lambda _: None)
    assert photographs.inputs.images.equal(full.inputs.images)
    targets, where = photographs.held_out, torch.as_tensor(inside > 0)
    assert targets.images[:, :, ~where].eq(1).all()
    assert targets.images[:, :, where].equal(full.held_out.images[:, :, where])
    gray = torch.full_like(targets.images, 0.5)
    error = (full.held_out.images[:, :, where] - 0.5).square().mean((1, 2))
    metrics = masked.read_metrics()
    torch.testing.assert_close(metrics.psnr(gray, targets), -10 * error.log10())
    values = metrics.image_metrics(gray, targets, None)
    white = torch.where(where, gray, 1.0)
    expected = PROTOCOLS["llff_3_views"].read_metrics().image_metrics(white, targets, None)
    assert values["ssim"].equal(expected["ssim"])
    assert "over the pixels of its mask" in metrics.describe()["psnr"]


def test_our_rows_stand_between_published_ones_and_are_kept(
    fern, make_options, tmp_path, monkeypatch
):
    changed = [SMALL]
    monkeypatch.setattr(report, "read_protocols", lambda: {"small": changed[0]})
    others = [PublishedRow("Best", 99.0, "paper"), PublishedRow("Worst", 1.0, "paper")]
    monkeypatch.setattr(
        report, "published_rows", lambda _, scene: others if scene == "fern" else []
    )
    opened = []

    def opening(*options):
        opened.append(options)
        return open_published(*options)

    monkeypatch.setattr(report, "open_published", opening)
    public = {"marks": [0.05, 0.5], "curve_views": 1, "images": {}, "ours": {"sh_degree": 0}}
    options = make_options("public", {"public": public, "data": {"root": str(fern.parent)}})
    options.output = str(tmp_path)
    first = report.measure(options, Console(quiet=True))
    assert [row["mark"] for row in first["rows"]] == [None, 0.05, 0.5] and len(opened) == 1
    assert [row["views"] for row in first["rows"]] == [1, 1, 2]
    assert first["rows"][0]["psnr"] < first["rows"][-1]["psnr"]
    assert len(list((tmp_path / "public").glob("small-fern-*.png"))) == 1
    again = report.measure(options, Console(quiet=True))
    assert again == first and len(opened) == 1  # nothing is measured again
    changed[0] = replace(SMALL, metrics="longlrm")
    other = report.measure(options, Console(quiet=True))
    assert other["rows"][0]["fingerprint"] != first["rows"][0]["fingerprint"] and len(opened) == 2
    changed[0] = SMALL
    theirs = tmp_path / "theirs"
    targets, _ = open_published(SMALL, fern, lambda _: None)
    for file, image in zip(targets.held_out_files, targets.held_out.images, strict=True):
        path = theirs / "small" / "fern" / Path(file).name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(image, path)
    options.public.images = {"copier": {"folder": str(theirs), "seconds": 7}}
    results = report.measure(options, Console(quiet=True))
    results |= {"machine": {"cpu": "a"}, "revision": "b"}
    assert results["rows"][-1]["method"] == "copier" and results["rows"][-1]["psnr"] == 100
    methods = [row["method"] for row in report.merged_rows(results["rows"], "small", "fern")]
    assert methods[:2] == ["copier", "Best"] and methods[-1] == "Worst"
    (table,) = report.tables(results)
    assert list(table.columns[0].cells) == methods and "nerfbaselines" not in table.caption
    (axes,) = report.plot(results).axes
    assert [text.get_text() for text in axes.texts] == ["Best", "Worst"]
