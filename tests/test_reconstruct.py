"""The script: what it writes, and its errors, on tiny synthetic photographs."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from full_disk import largest_file
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pretend_device import DEVICE, pretended_device
from safetensors import safe_open
from scipy.spatial.transform import Rotation

from asysplat import load, read_gaussians, render
from asysplat.data import ProceduralScene, SceneOptions, open_scene
from asysplat.data.readers.transforms import read_cameras
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.export import write_ply
from asysplat.reconstruct.continuation import continue_run
from asysplat.reconstruct.results import save_gaussians
from asysplat.refinement import DEFAULT, FEW
from asysplat.root import CONF
from asysplat.runs.runs import find_reconstructions

SIZE = 48
LAYOUTS = Path(__file__).parent / "data" / "readers"  # writers of them
TINY = (f"height={SIZE}", "steps=60", "refinement.max_gaussians=3000", "views=12")
TINY += ("init=plane_sweep", "video.seconds=0.2", "paths.weights=none", "cameras=given")
FILES = {"scene.ply", "scene.html", "scene.safetensors", "path.mp4", "contact.png", "start.png"}
FILES |= {"metrics.json", "metrics.csv", "config.yaml", "transforms.json"}


@pytest.fixture(scope="session")
def views():
    scene = ProceduralScene(seed=7, height=SIZE, width=SIZE, num_images=16)
    return scene.views(range(scene.num_images))


@pytest.fixture(scope="session")
def photographs(views, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs") / "scene"
    write_transforms(views, folder)
    return folder


@pytest.fixture(scope="session")
def network(composed, tmp_path_factory):
    """The option that names the checkpoint of a small network."""
    folder = tmp_path_factory.mktemp("trained")
    config = composed("width=0.125", "state_size=8", "model.layers=1m1s")
    model = OmegaConf.to_container(config.model, resolve=True)
    OmegaConf.save({"model": model}, folder / "config.yaml")
    weights = {f"net.{name}": x for name, x in instantiate(config.model).state_dict().items()}
    (folder / "checkpoints").mkdir()
    torch.save({"state_dict": weights}, folder / "checkpoints" / "last.ckpt")
    return f"checkpoint={folder}/checkpoints/last.ckpt"


@pytest.fixture
def command(run_script, tmp_path):
    """The script in this process with tiny options by default; its folder is tmp_path/run."""
    return make_command(run_script, tmp_path / "run")


def make_command(run_script, folder):
    def run(path, *overrides):
        keys = [override.split("=")[0] for override in overrides]
        tiny = [option for option in TINY if option.split("=")[0] not in keys]
        words = [] if path is None else [path]
        shutil.rmtree(folder, ignore_errors=True)  # else the next one is run-2
        return run_script("reconstruct.py", *words, *overrides, *tiny, f"paths.run={folder}")

    return run


@pytest.fixture(scope="module")
def first(run_script, photographs, tmp_path_factory):
    """The folder of a finished reconstruction, and what the script said."""
    folder = tmp_path_factory.mktemp("first") / "run"
    return folder, finished(make_command(run_script, folder)(photographs))


def finished(result):
    assert result.returncode == 0, result.stderr
    return result.stdout


def numbers_of(folder):
    return json.loads((folder / "metrics.json").read_text())


def rows_of(folder):
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.medium
@pytest.mark.parametrize("init", ["plane_sweep", "network"])
def test_all_runs_on_the_device_of_the_option(
    command, photographs, network, tmp_path, monkeypatch, init
):
    def find(name):
        assert name == "auto"
        return DEVICE

    options = ("steps=3", "refinement.max_gaussians=1000", "views=10", "height=24")
    options += ("video.path=orbit", f"init={init}", network)
    finished(command(photographs, *options))
    expected = numbers_of(tmp_path / "run")
    monkeypatch.setattr("asysplat.runs.machine.find_device", find)
    net = load(network.partition("=")[2])  # torch reads no checkpoint where it pretends
    monkeypatch.setattr("asysplat.load", lambda _: net)
    with pretended_device(monkeypatch):
        finished(command(photographs, *options))
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES
    numbers = numbers_of(tmp_path / "run")
    # In float32 a kernel and torch's operators part after some steps of Adam, and where cells merge
    # by a last bit: with fewer Gaussians one of them would count.
    for name, tolerance in (
        ("inputs/psnr", 0.01),
        ("held_out/psnr", 0.01),
        ("held_out/absrel", 0.05),
    ):
        assert numbers[name] == pytest.approx(expected[name], rel=tolerance)


@pytest.mark.medium
def test_the_result_folder_has_every_file_and_beats_the_baselines(first, photographs):
    folder, said = first
    assert {path.name for path in folder.iterdir()} == FILES
    numbers = numbers_of(folder)
    for baseline in ("nearest_view", "mean_color"):
        assert numbers["held_out/psnr"] > numbers[f"baseline/{baseline}/psnr"] + 1
        assert numbers["held_out/ssim"] > numbers[f"baseline/{baseline}/ssim"]
    for depth in ("", "median_depth_"):
        error, close = (numbers[f"held_out/{depth}{name}"] for name in ("absrel", "delta1"))
        assert error < 0.6 * numbers["baseline/mean_inverse_depth/absrel"]
        assert close > numbers["baseline/mean_inverse_depth/delta1"]
    assert 0.5 < numbers["held_out/seen/share"] < 1
    for part in ("seen", "fitted"):  # what no input shows, and other exposures, are not to blame
        assert numbers["held_out/psnr"] < numbers[f"held_out/{part}/psnr"]
    assert "mean inverse depth" in said
    assert numbers["steps"] == 60 and numbers["gaussians"] <= 3000
    rows = rows_of(folder)
    assert [row["set"] for row in rows] == ["inputs"] * 12 + ["held_out"] * 2
    assert [Path(row["file"]).stem for row in rows[12:]] == ["00000", "00008"]
    for name in ("inputs", "held_out"):
        values = [float(row["psnr"]) for row in rows if row["set"] == name]
        assert sum(values) / len(values) == pytest.approx(numbers[f"{name}/psnr"], abs=1e-4)
    assert yaml.safe_load((folder / "config.yaml").read_text())["path"] == str(photographs)
    for name in ("start.png", "contact.png"):
        assert cv2.imread(str(folder / name)).std() > 20
    assert cv2.VideoCapture(str(folder / "path.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 6
    assert "held out" in said and f"scene: {folder / 'scene.ply'}" in said.replace("\n", "")
    ply, tensors = (read_gaussians(folder / f"scene.{suffix}") for suffix in ("ply", "safetensors"))
    assert ply.num_gaussians == tensors.num_gaussians == numbers["gaussians"]
    torch.testing.assert_close(ply.means, tensors.means)


@pytest.mark.medium
def test_a_last_fit_has_the_held_out_photographs_and_leaves_the_metrics(
    command, first, views, photographs, tmp_path
):
    held_out = views.select([0, 8])

    def error(folder):
        gaussians = read_gaussians(folder / "scene.ply")
        image = render(gaussians, held_out.cameras, held_out.images.mean((0, 2, 3))).image
        return (image - held_out.images).square().mean()

    finished(command(photographs, "last_fit=1", "video.path=none"))
    before, after = first[0], tmp_path / "run"
    assert numbers_of(after) | {"seconds": None} == numbers_of(before) | {"seconds": None}
    assert error(after) < 0.7 * error(before)


@pytest.mark.medium
@pytest.mark.parametrize("unit", [pytest.param(0.1, marks=pytest.mark.slow), 1e3])
def test_the_scene_is_in_the_world_of_the_files(command, views, tmp_path, unit):
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor(Rotation.from_euler("xyz", (0.4, -1.1, 2.0)).as_matrix())
    turn[:3, 3] = torch.tensor([3.0, -2.0, 5.0])
    poses = turn @ views.cameras.cam_to_world.double()
    poses[:, :3, 3] *= unit
    cameras = replace(views.cameras, cam_to_world=poses.float())
    write_transforms(replace(views, cameras=cameras, depths=None), tmp_path / "photographs")
    finished(command(tmp_path / "photographs"))
    folder = tmp_path / "run"
    gaussians = read_gaussians(folder / "scene.ply")
    with safe_open(folder / "scene.safetensors", "pt") as file:
        background = torch.tensor([float(x) for x in file.metadata()["background"].split()])
    rows = rows_of(folder)
    seen = open_scene(tmp_path / "photographs", SceneOptions(SIZE, SIZE))
    seen = seen.views([int(Path(row["file"]).stem) for row in rows])
    written = read_cameras(folder / "transforms.json")
    torch.testing.assert_close(
        written.cam_to_world, seen.cameras.cam_to_world, rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(written.intrinsics, seen.cameras.intrinsics)
    entries = json.loads((folder / "transforms.json").read_text())["frames"]
    assert [entry["file_path"] for entry in entries] == [row["file"] for row in rows]
    images = render(gaussians, seen.cameras, background).image.clamp(0, 1)
    psnr = -10 * (images - seen.images).square().mean((1, 2, 3)).log10()
    assert psnr.min() > 20
    expected = torch.tensor([float(row["psnr"]) for row in rows])
    torch.testing.assert_close(psnr, expected, atol=0.01, rtol=0)


@pytest.mark.medium
def test_photographs_of_other_exposures_are_fitted_as_if_of_one(command, views, tmp_path):
    gains = torch.tensor([0.7, 1.0]).repeat(views.num_views)[: views.num_views, None, None, None]
    write_transforms(replace(views, images=views.images * gains), tmp_path / "scene")
    quality = {}
    for exposure in ("given", "auto"):
        said = finished(command(tmp_path / "scene", f"exposure={exposure}", "last_fit=0.5"))
        assert ("1.4 times as bright as others" in said) == (exposure == "auto")
        quality[exposure] = numbers_of(tmp_path / "run")
    for name in ("inputs/psnr", "held_out/fitted/psnr"):
        assert quality["auto"][name] > quality["given"][name], name


@pytest.mark.medium
def test_masked_photographs_measure_alike_by_both_scripts(
    command, first, views, run_script, tmp_path
):
    """Before the background that both files name: the evaluation's own inputs have another."""
    photographs = tmp_path / "masked"
    images = views.images.clone()
    images[..., : SIZE // 3, :] = 1
    write_transforms(replace(views, images=images, depths=None), photographs)
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[: SIZE // 3] = 0
    (photographs / "masks").mkdir()
    for path in (photographs / "images").iterdir():
        cv2.imwrite(str(photographs / "masks" / f"{path.stem}.png"), mask)
    start = read_gaussians(first[0] / "scene.ply")
    write_ply(tmp_path / "start.ply", replace(start, opacities=0.1 * start.opacities))
    init = f"init={tmp_path / 'start.ply'}"
    finished(command(photographs, init, "steps=1", "video.path=none"))
    expected = numbers_of(tmp_path / "run")
    data = ["data=files", f"data.root={photographs}", "data.inputs=2"]
    data += [f"data.height={SIZE}", f"data.width={SIZE}"]
    data += ["data.num_workers=0", f"paths.logs={tmp_path}", "post_optimization_steps=0"]
    for suffix in ("ply", "safetensors"):
        scene = tmp_path / "run" / f"scene.{suffix}"
        folder = finished(run_script("evaluate.py", f"gaussians={scene}", *data)).split()[-1]
        found = json.loads((Path(folder) / "evaluation.json").read_text())
        for metric in ("psnr", "ssim"):
            reconstructed = expected[f"held_out/{metric}"]
            assert found[f"test/files/post0/{metric}"] == pytest.approx(reconstructed, abs=1e-3)


@pytest.mark.medium
def test_the_same_steps_and_seed_give_the_same_bytes(command, photographs, tmp_path):
    def scene(seed):
        options = (f"seed={seed}", "steps=20", "held_out_every=null", "video.path=none")
        finished(command(photographs, *options))
        return (tmp_path / "run" / "scene.ply").read_bytes()

    first = scene(0)
    assert scene(0) == first
    assert scene(1) != first


@pytest.mark.medium
@pytest.mark.parametrize("init", ["network", "depth", "points", "file"])
def test_each_init_beats_its_baseline(
    command, first, views, photographs, network, tmp_path, monkeypatch, init
):
    if init == "points":
        monkeypatch.syspath_prepend(LAYOUTS)
        photographs = import_module("layouts.colmap").write(views, tmp_path / "colmap")
    elif init == "file":
        init = shutil.copy(first[0] / "scene.ply", tmp_path / "a first scene.ply")
        before = numbers_of(first[0])
    assert f"init={init}" in finished(command(photographs, f"init='{init}'", "steps=40", network))
    after = numbers_of(tmp_path / "run")
    if init == "network":  # untrained
        assert after["held_out/psnr"] > after["baseline/mean_color/psnr"] + 5
    elif init == "points":  # a few, at the rims of the photographs, without depths
        measured = {key for key in after if not key.startswith("protocol")}
        assert not [key for key in measured if "absrel" in key or "depth" in key]
        assert after["inputs/psnr"] > after["baseline/mean_color/psnr"]
    elif Path(init).suffix:  # goes on where the other was
        assert after["held_out/psnr"] > before["held_out/psnr"] - 0.5
    else:
        assert after["held_out/psnr"] > after["baseline/nearest_view/psnr"] + 1


@pytest.mark.medium
def test_a_scene_is_written_in_the_formats_of_output(command, photographs, tmp_path, monkeypatch):
    opened, folder = [], tmp_path / "run"
    monkeypatch.setattr("webbrowser.open", opened.append)
    options = ("steps=5", "held_out_every=null", "video.path=none")
    said = finished(command(photographs, *options, "output=[spz,html,compressed.ply]", "open=true"))
    files = {f"scene.{suffix}" for suffix in ("spz", "html", "compressed.ply", "safetensors")}
    assert {file.name for file in folder.glob("scene.*")} == files
    assert opened == [(folder / "scene.html").as_uri()]
    assert f"page: {folder / 'scene.html'}" in said and f"scene: {folder / 'scene.spz'}" in said
    page = (folder / "scene.html").read_text()
    assert str(photographs.parent) not in page  # nothing of the disk goes to who gets the page
    assert find_reconstructions(tmp_path) == [folder]


@pytest.mark.medium
def test_scaffold_gs_has_metrics_and_pictures_but_no_scene_file(
    command, run_script, photographs, tmp_path
):
    folder = tmp_path / "run"
    options = ("refinement=scaffold_gs", "init=depth", "refinement.voxel=0.02")
    said = finished(command(photographs, *options, "steps=150", "refinement.max_gaussians=20000"))
    assert {path.name for path in folder.iterdir()} == FILES - {
        name for name in FILES if name.startswith("scene.")
    }
    assert "scene:" not in said
    numbers = numbers_of(folder)
    assert numbers["steps"] == 150 and numbers["gaussians"] <= 20_000
    assert numbers["held_out/psnr"] > numbers["baseline/nearest_view/psnr"] + 1
    check_refusal(run_script("reconstruct.py", f"run={folder}"), "has no scene.safetensors")


@pytest.mark.medium
def test_a_run_goes_on_from_a_finished_one(command, run_script, photographs, tmp_path):
    small = ("height=40", "views=5", "held_out_every=4", "video.path=none")
    finished(command(photographs, *small))
    first = (tmp_path / "run").rename(tmp_path / "first")
    before, files = numbers_of(first), {file: file.read_bytes() for file in first.iterdir()}
    options = ("steps=40", "views=6", "video.path=none", "paths.weights=none")
    said = finished(run_script("reconstruct.py", "run=last", f"paths.logs={tmp_path}", *options))
    assert f"goes on from {first}, on the photographs {photographs}" in said
    assert {file: file.read_bytes() for file in first.iterdir()} == files
    (folder,) = (tmp_path / "reconstruct").iterdir()
    config, after = OmegaConf.load(folder / "config.yaml"), numbers_of(folder)
    assert (config.height, config.held_out_every, config.views) == (40, 4, 6)
    assert (config.run, config.init) == (str(first), str(first / "scene.safetensors"))
    assert (
        config.refinement.half_resolution_until == 0 and config.refinement.max_gaussians == 150_000
    )
    assert after["held_out/psnr"] > before["held_out/psnr"] - 0.5


@pytest.fixture
def run_folder(tmp_path):
    """A finished reconstruction as far as its files tell, with this configuration."""

    def write(content):
        folder = tmp_path / "old"
        folder.mkdir(exist_ok=True)
        for name in ("metrics.json", "scene.safetensors", "scene.ply"):
            (folder / name).write_text("{}")
        OmegaConf.save(OmegaConf.create(content), folder / "config.yaml")
        return folder

    return write


def test_only_what_describes_the_photographs_is_taken_from_a_run(run_folder, script):
    stored = {"path": "scene", "height": 300, "views": 7, "frames": 9, "seed": 5, "seconds": 600}
    stored["background"] = [0.0, 0.5, 0.0]
    stored |= {"paths": {"run": "elsewhere"}, "checkpoint": "x", "video": {"path": "orbit"}}
    folder = run_folder(stored)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["path=mine", f"run={folder}", "paths.run=new", "quality=best"]
        config = compose("reconstruct", words)
    for given, height, views in (
        ({"run"}, 300, 7),
        ({"run", "views"}, 300, None),
        ({"run", "quality"}, 540, None),
    ):
        continued = script.continue_run(config, given)
        assert (continued.height, continued.views, continued.frames) == (height, views, 9)
        assert (continued.path, continued.width) == ("scene", None)
        assert continued.background == [0.0, 0.5, 0.0]
        assert continued.init == str(folder / "scene.safetensors")
        assert continued.refinement.half_resolution_until == 0
        for key in ("seed", "seconds", "paths", "checkpoint", "video"):
            assert continued[key] == config[key]
    given = {"run", "path", "init", "refinement.half_resolution_until"}
    continued = script.continue_run(config, given)
    assert (continued.path, continued.init) == ("mine", config.init)
    assert continued.refinement.half_resolution_until == config.refinement.half_resolution_until > 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"height": 9}, "config.yaml has no path of photographs"),
        ({"path": "a", "x": {"_target_": "os.system"}}, "os.system"),
        (None, "has no scene.safetensors: name the folder of a finished run, or last"),
    ],
)
def test_a_run_of_another_kind_is_refused(run_folder, script, content, message):
    folder = run_folder(content or {"path": "a"})
    if content is None:
        (folder / "scene.safetensors").unlink()
    config = OmegaConf.create({"run": str(folder), "paths": {"logs": "none"}})
    with pytest.raises(InputError, match=message):
        script.continue_run(config, ())


@pytest.mark.medium
def test_only_a_start_from_the_network_reads_its_weights(command, photographs):
    overrides = ("views=4", "checkpoint=absent.safetensors", "steps=2")
    said = finished(command(photographs, *overrides))
    assert "by init=plane_sweep" in said and "refinement.max_steps_per_image" not in said
    check_refusal(
        command(photographs, "init=network", *overrides), "absent.safetensors does not exist"
    )


@pytest.mark.medium
def test_odd_paths_and_the_end_by_max_steps_per_image(command, photographs, tmp_path):
    limit = ("refinement.max_steps_per_image=2", "steps=null", "seconds=600")
    path = tmp_path / "it's \"a=b\", [c] \\'scene\\"
    path.symlink_to(photographs)
    said = finished(command(path, "views=3", "video.path=none", *limit))
    used = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert used["path"] == str(path)
    assert "few photographs: refinement=few" in said
    assert used["refinement"]["opacity_decay"] == FEW.opacity_decay < 1
    assert used["refinement"]["max_steps_per_image"] == 2 != DEFAULT.max_steps_per_image
    assert "ended after refinement.max_steps_per_image=2" in said
    assert numbers_of(tmp_path / "run")["steps"] == 6


@pytest.fixture
def script(repository, monkeypatch):
    """The script as a module."""
    monkeypatch.syspath_prepend(repository)
    on_interrupt = signal.getsignal(signal.SIGINT)
    yield import_module("reconstruct")
    signal.signal(signal.SIGINT, on_interrupt)


REFUSED = {
    "": "no photographs: python reconstruct.py my_scene",
    "heigth=9": "'heigth': did you mean height?",
    "video.path=[00001.png,x.png]": "video.path: x.png is the name of none of the 14 photographs",
    "refinement.densify_until=2.5": "refinement.densify_until=2.5 should be less than",
    "output=[ply,obj]": "output has 'obj': choose from compressed.ply, ply, spz, sog, glb, splat,",
    "output=[ply] open=true": "open=true opens the page, which output= leaves out: add html to it",
    "refinement=scaffold_gs last_fit=0.2": "last_fit=0.2: the Gaussians of refinement=scaffold_gs",
}


def check_refusal(result, message):
    assert result.returncode == 1
    assert message in result.stderr and "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.medium
@pytest.mark.parametrize("overrides", REFUSED)
def test_a_mistake_is_one_sentence_and_status_1(command, photographs, tmp_path, overrides):
    result = command(photographs if overrides else None, *overrides.split())
    check_refusal(result, REFUSED[overrides])
    assert not list(tmp_path.rglob("scene.*"))


@pytest.mark.parametrize(
    ("steps", "seconds", "message"),
    [
        (None, 0, "seconds=0 should be greater than 0."),
        (0.5, None, "steps=0.5 should be a valid integer."),
        (3, 5, "seconds=5 and steps=3: give one of them"),
    ],
)
def test_one_limit_above_0_is_given(script, monkeypatch, steps, seconds, message):
    given = {"steps", "seconds"} if steps and seconds else set()
    monkeypatch.setattr(script, "given_options", lambda: given)
    with pytest.raises(InputError, match=message):
        script.read_limit(OmegaConf.create({"steps": steps, "seconds": seconds}))


@pytest.mark.parametrize(
    ("count", "limit", "decide", "gain", "takes_few"),
    [
        (9, {"seconds": 59.0}, True, -1.0, True),
        (10, {"steps": 999}, True, 1.0, False),
        (9, {"seconds": 60.0}, False, -1.0, True),
        (9, {"seconds": 60.0}, True, -0.2, True),
        (9, {"seconds": 60.0}, True, -0.4, False),
        (10, {"steps": 1000}, True, 0.2, False),
        (10, {"steps": 1000}, True, 0.4, True),
        (7, {"steps": 1000}, True, -1.0, True),
    ],
)
def test_a_trial_decides_whether_photographs_are_few(
    script, monkeypatch, capsys, views, count, limit, decide, gain, takes_few
):
    monkeypatch.setattr(script, "given_options", lambda: {"path", "refinement.ssim"})
    monkeypatch.setattr(script, "trial_gain", lambda *_: (gain, 0.35))
    options = OmegaConf.load(CONF / "refinement" / "default.yaml")
    config = OmegaConf.create({"refinement": options, "decide": decide, "seed": 0})
    left = script.choose_refinement(config, views.select(list(range(count))), limit)
    assert config.refinement.opacity_decay == (FEW if takes_few else DEFAULT).opacity_decay
    assert config.refinement.ssim == DEFAULT.ssim
    tried = decide and count >= 8 and limit in ({"seconds": 60.0}, {"steps": 1000})
    said = capsys.readouterr().out
    assert ("trial" in said) == tried and ("refinement=few" in said) == (tried or takes_few)
    assert left.keys() == limit.keys() and (left == limit) == (not tried or "steps" in limit)


def test_run_last_without_any_run_names_the_folder(tmp_path):
    config = OmegaConf.create({"run": "last", "paths": {"logs": f"{tmp_path}/nowhere"}})
    with pytest.raises(InputError, match=r"run=last found no finished run in .*nowhere"):
        continue_run(config, ())


def test_too_few_photographs_are_refused(command, views, tmp_path):
    write_transforms(views.select([0, 5]), tmp_path / "two")
    message = "has 2 photographs, of which held_out_every=8 leaves 1"
    check_refusal(command(tmp_path / "two"), message)


@pytest.mark.medium
def test_cameras_without_overlap_end_without_an_error(command, views, tmp_path):
    poses = views.cameras.cam_to_world.clone()
    poses[:, :3, 3] += 100 * torch.arange(len(poses))[:, None]
    apart = replace(views, cameras=replace(views.cameras, cam_to_world=poses), depths=None)
    write_transforms(apart, tmp_path / "apart")
    finished(command(tmp_path / "apart", "steps=5"))


@pytest.mark.medium
def test_small_photographs_are_measured_without_lpips(command, photographs, tmp_path, shared):
    small = ("height=24", "views=4", "steps=2", "video.path=none")
    result = command(photographs, *small, f"paths.weights={shared}/weights")
    finished(result)
    assert "without LPIPS" in result.stderr
    assert "held_out/lpips" not in numbers_of(tmp_path / "run")


def test_a_scene_is_kept_where_the_disk_is_full(make_scene, tmp_path, monkeypatch):
    scene, _ = make_scene(count=40, degree=3, dtype=torch.float32)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "other"))
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    (tmp_path / "home").mkdir()
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / "scene.ply"
    lost = tmp_path / "lost" / "scene.ply"
    with pytest.raises(InputError, match=r"written to \S+home/lost-scene\.ply\."):
        save_gaussians(lost, scene)
    assert read_gaussians(tmp_path / "home" / "lost-scene.ply").num_gaussians == 40
    with largest_file(5000), pytest.raises(InputError, match=r"^(?!.*written to)"):
        save_gaussians(path, scene)
    assert not list((tmp_path / "run").iterdir())
    save_gaussians(path, scene)
    assert read_gaussians(path).num_gaussians == 40


@pytest.fixture
def process(repository, photographs, tmp_path):
    """The script in an interpreter of its own, which takes SIGINT as in a terminal."""

    tiny = [f"paths.run={tmp_path / 'run'}", *TINY[:1], *TINY[2:]]

    def start(*overrides):
        return subprocess.Popen(
            [sys.executable, "reconstruct.py", photographs, *overrides, *tiny],
            cwd=repository,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=as_in_a_terminal,
        )

    started = []
    yield lambda *overrides: started.append(start(*overrides)) or started[-1]
    for one in started:
        one.kill()
        one.wait()


def as_in_a_terminal():
    """Handle signals as a terminal's processes do, however the tests were started."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.medium
@pytest.mark.parametrize(
    "numbers",
    [
        [signal.SIGINT],
        [signal.SIGTERM, signal.SIGHUP, signal.SIGHUP, signal.SIGTERM],
        [signal.SIGINT, signal.SIGINT],
    ],
)
def test_the_first_signal_saves_and_the_second_interrupt_stops(process, tmp_path, numbers):
    running = process("seconds=600")
    while not running.stdout.readline().startswith("figure:"):
        assert running.poll() is None, running.stderr.read()
    time.sleep(1)
    running.send_signal(numbers[0])
    assert running.stderr.readline().startswith("stopping after this step")
    for number in numbers[1:]:
        running.send_signal(number)
        time.sleep(0.02)
    _, errors = running.communicate(timeout=60)
    file = tmp_path / "run" / "scene.ply"
    if numbers[1:] != [signal.SIGINT]:
        assert running.returncode == 0 and read_gaussians(file).num_gaussians > 0, errors
        assert {"metrics.json", "contact.png"} <= {path.name for path in file.parent.iterdir()}
    else:
        assert running.returncode == 1 and errors.endswith("stopped.\n"), errors
        assert not list((tmp_path / "run").glob(".*"))
