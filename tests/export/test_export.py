"""The command that writes a scene in another format."""

import json

import pytest
import torch

from asysplat import read_gaussians, render, write_gaussians
from asysplat.data.write import describe_cameras
from asysplat.errors import InputError
from asysplat.export.__main__ import export
from asysplat.export.gaussians import CAMERAS, Notes
from asysplat.export.importance import most_important
from asysplat.rendering import blending_weights


@pytest.fixture
def scene(make_scene):
    return make_scene(count=60, views=3, degree=2, height=26, width=34, dtype=torch.float32)


@pytest.fixture
def file(scene, tmp_path):
    """A scene with its cameras beside it, an offset and a background."""
    gaussians, cameras = scene
    write_gaussians(tmp_path / "scene.ply", gaussians, Notes((1e6, 0.0, 0.0), (0.5, 0.25, 1.0)))
    content = describe_cameras(cameras, [f"{view}.png" for view in range(3)])
    (tmp_path / CAMERAS).write_text(json.dumps(content))
    return tmp_path / "scene.ply"


def test_the_most_important_gaussians_are_kept_in_their_order(scene):
    gaussians, cameras = scene
    kept = gaussians.keep(most_important(gaussians, 0.5, cameras))
    weights = blending_weights(gaussians, cameras)
    order = weights.argsort(descending=True)[:30].sort().values
    assert torch.equal(kept.means, gaussians.means[order])
    assert most_important(gaussians, 1e-9, None).sum() == 1

    def difference(scene):
        return (render(scene, cameras).image - render(gaussians, cameras).image).square().mean()

    least = gaussians.keep(weights < weights.median())
    assert difference(kept) < 0.2 * difference(least)


def test_a_scene_is_written_and_measured(file, capsys):
    export(file, file.with_name("small.spz"), keep=0.5, sh_degree=0)
    written = read_gaussians(file.with_name("small.spz"))
    assert written.num_gaussians == 30 and written.sh.shape == (30, 1, 3)
    said = capsys.readouterr().out
    assert "small.spz: 30 Gaussians, 0.00 MB" in said
    assert ".spz has no place for the offset 1000000.0 0.0 0.0" in said
    export(file, file.with_name("whole.safetensors"))
    said = capsys.readouterr().out
    assert "offset" not in said and "inf dB" not in said
    assert read_gaussians(file.with_name("whole.safetensors"), (0.0, 0.0, 0.0)).means[0, 0] > 9e5


def test_what_cannot_be_written_is_refused_before_the_scene_is_read(file):
    missing, existing = file.with_name("missing.ply"), file.with_name("old.spz")
    existing.write_text("old")
    for output, keep, message in (
        (file.with_name("scene.obj"), 1.0, r"scene\.obj cannot be written"),
        (file.with_name("scene.spz"), 0.0, "--keep is 0: give a fraction above 0, at most 1"),
        (existing, 1.0, r"old\.spz exists: remove it, or name another file"),
    ):
        with pytest.raises(InputError, match=message):
            export(missing, output, keep)
    assert existing.read_text() == "old"
