"""`asysplat prepare`: what it writes is read as the photographs are."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from layouts import colmap as colmap_layout
from layouts import cut, dl3dv
from PIL import Image
from safetensors.numpy import load

from asysplat.data import SceneOptions, files_data, open_scene
from asysplat.data.datamodule import TrainingTasks
from asysplat.data.prepare.__main__ import main, read_arguments
from asysplat.data.write import write_transforms

SIZES = [(12, 16), (16, 16), (24, 32)]


@pytest.fixture
def prepare(capsys):
    """Runs the command in this process; returns its exit status and what it printed."""

    def run(root, out, *options, sizes="12x16,16,24x32"):
        words = [str(root), str(out), "--sizes", sizes, "--workers", "1", *options]
        return main(read_arguments(words)), "".join(capsys.readouterr())

    return run


def file_of(scene):
    """One of a scene's files."""
    return next(scene.parent.glob(f"*/{scene.name}.safetensors"))


def distorted(views, folder):
    """With sparse points, and a lens that distorts."""
    colmap_layout.write(views, folder)
    file = folder / "sparse/0/cameras.txt"
    lines = file.read_text().replace(" PINHOLE ", " OPENCV ").splitlines()
    file.write_text("\n".join(line + " 0.1 0 0 0" * (line[0] != "#") for line in lines))


def depths(views, folder):
    write_transforms(views, folder)


def cut_out(views, folder):
    """An object whose photographs are transparent elsewhere."""
    write_transforms(replace(views, depths=None), folder)
    for file in (folder / "images").iterdir():
        image = Image.open(file).convert("RGBA")
        image.putalpha(Image.linear_gradient("L").resize(image.size))
        image.save(file)


def masked(views, folder):
    """An object with masks beside its photographs, which are soft at the border."""
    write_transforms(replace(views, depths=None), folder)
    (folder / "masks").mkdir()
    for file in (folder / "images").iterdir():
        mask = Image.radial_gradient("L").resize((32, 24)).point(lambda level: 255 - level)
        mask.save(folder / "masks" / file.name)


@pytest.mark.parametrize("write", [distorted, depths, cut_out, masked])
def test_without_loss_it_is_what_the_folder_holds(prepare, few, tmp_path, write):
    write(few, tmp_path / "data" / "scene")
    status, said = prepare(tmp_path / "data", tmp_path / "out", "--lossless")
    assert status == 0 and f"{tmp_path}/out: 1 scenes written, 0 were there, 0 are bad" in said
    assert_alike(tmp_path / "data" / "scene", file_of(tmp_path / "out" / "scene"))


def test_an_archive_holds_a_scene(prepare, few, tmp_path):
    unpacked = tmp_path / "unpacked"
    dl3dv.write_scene(few, unpacked / dl3dv.HASH)
    shutil.make_archive(str(tmp_path / "data" / "1K" / dl3dv.HASH), "zip", unpacked)
    assert prepare(tmp_path / "data", tmp_path / "out", "--lossless")[0] == 0
    assert_alike(unpacked / dl3dv.HASH, file_of(tmp_path / "out" / dl3dv.HASH))


def assert_alike(source, found):
    for size in SIZES:
        old, new = (open_scene(path, SceneOptions(*size)) for path in (source, found))
        assert (new.name, new.num_images, new.scene.origin) == (old.name, 4, old.scene.origin)
        before, after = old.views(range(4)), new.views(range(4))
        assert torch.equal(before.cameras.intrinsics, after.cameras.intrinsics)
        assert torch.equal(before.cameras.cam_to_world, after.cameras.cam_to_world)
        for kind in ("images", "depths", "masks", "alphas"):
            one, other = getattr(before, kind), getattr(after, kind)
            assert (one is None) == (other is None) and (one is None or torch.equal(one, other))
        assert (old.points is None) == (new.points is None)
        assert old.points is None or (old.points == new.points).all()


def test_a_file_of_another_size_is_resized(prepare, few, tmp_path):
    depths(few, tmp_path / "data")
    prepare(tmp_path / "data", tmp_path / "out", sizes="12x16,24x32")
    scene = open_scene(file_of(tmp_path / "out" / "data"), SceneOptions(6, 8))
    assert scene.scene.images[0].lens.height == 24
    smaller = few.resized(6, 8).images
    assert (scene.views(range(4)).images - smaller).square().mean() < 1e-3


def test_an_image_is_read_alone(prepare, views, tmp_path, monkeypatch):
    write_transforms(views, tmp_path / "data")
    prepare(tmp_path / "data", tmp_path / "out", sizes="24x32")
    sequence = open_scene(file_of(tmp_path / "out" / "data"), SceneOptions(24, 32))
    pread, sizes = os.pread, []
    monkeypatch.setattr(os, "pread", lambda *args: sizes.append(args[1]) or pread(*args))
    read = sequence.views([7, 3])
    files = [sequence.scene.images[index] for index in (7, 3)]
    stored = [image.file for image in files] + [image.depth for image in files]
    assert sizes[:4] == [len(file.read()) for file in stored] and len(sizes) == 8
    assert (read.images - views.images[[7, 3]]).abs().mean() < 0.02


def test_the_same_command_goes_on(prepare, folder, tmp_path):
    root, out = folder("data", 0, 1, 2, 3, 4), tmp_path / "out"
    assert prepare(root, out, "--part", "2/2", sizes="16")[0] == 0
    files = sorted((out / "16x16").iterdir())
    assert [file.stem for file in files] == ["s1", "s3"]
    before = [file.stat().st_mtime_ns for file in files]
    _, said = prepare(root, out, sizes="16")
    assert f"{out}: 3 scenes written, 2 were there, 0 are bad" in said
    assert [file.stat().st_mtime_ns for file in files] == before
    status, said = prepare(root, out, "--lossless", sizes="16")
    assert status == 2 and "s0.safetensors is stored as lanczos, JPEG, not as lanczos, " in said


def test_a_damaged_file_is_written_again(prepare, folder, tmp_path):
    root, out = folder("data", 0, 1), tmp_path / "out"
    prepare(root, out, sizes="16")
    file = out / "16x16" / "s1.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:-9] + b"x" + whole[-8:])
    status, said = prepare(root, out, "--verify", sizes="16")
    assert status == 0 and f"{file} is damaged" in said and "1 scenes written, 1 were" in said
    before, after = load(whole), load(file.read_bytes())
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.medium  # two processes import torch
def test_bad_scenes_are_listed_and_the_others_written(prepare, folder, tmp_path):
    root, out = folder("data", 0, 1, 2), tmp_path / "out"
    bad = tmp_path / "data" / "s1" / "images" / "00003.png"
    cut(bad)
    status, said = prepare(root, out, "--workers", "2", sizes="16")
    assert status == 1 and "2 scenes written, 0 were there, 1 are bad" in said
    listed = (out / "bad_scenes.txt").read_text()
    assert listed.startswith(f"{tmp_path}/data/s1: ") and f"{bad} cannot be read" in listed
    assert prepare(root, out, "--on-error", "skip", sizes="16")[0] == 0
    assert not (out / "bad_scenes.txt").exists()
    assert open_scene(file_of(out / "s1"), SceneOptions(16, 16)).num_images == 23


@pytest.mark.parametrize(
    "options, message",
    [
        (["--sizes", "0"], "--sizes has '0': expected sizes such as 256,512,544x960."),
        (["--part", "3/2"], "--part is 3/2: expected K/N with K from 1 to N, such as 3/64."),
    ],
)
def test_an_option_that_cannot_be_is_a_sentence(folder, tmp_path, capsys, options, message):
    words = [folder("data", 0), str(tmp_path / "out"), "--sizes", "16", *options]
    with pytest.raises(SystemExit, match="2"):
        read_arguments(words)
    assert capsys.readouterr().err == f"error: {message}\n"
    assert not (tmp_path / "out").exists()


def test_training_draws_the_same_tasks(prepare, folder, tmp_path):
    root, out = folder("data", 0, 1, 2, 3), tmp_path / "out"
    prepare(root, out, "--lossless", sizes="16")
    options = {"height": 16, "width": 16, "inputs": 4, "targets": 2, "window": [8, 16], "seed": 3}
    options |= {"name": "n", "batch_size": 1, "num_workers": 0, "steps_per_epoch": 1}
    options |= {"test_root": folder("test", 2), "val_scenes": 1}
    one, other = (TrainingTasks(files_data(root=str(r), **options)) for r in (root, out))
    for index in range(6):
        a, b = one[index], other[index]
        assert a["scene"] == b["scene"] and torch.equal(a["inputs"].images, b["inputs"].images)
        assert b["inputs"].images.dtype == torch.uint8
        assert torch.equal(a["targets"].cameras.cam_to_world, b["targets"].cameras.cam_to_world)
