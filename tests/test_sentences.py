"""What a stranger's files, arguments and commands may hold ends with a sentence that names it."""

import json
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import asysplat
from asysplat import load, read_gaussians, refine
from asysplat.data import ProceduralScene, SceneOptions, open_scene, photographs
from asysplat.data.bad_images import BadImages
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.refinement.adam import SelectiveAdam
from asysplat.runs.checkpoints import load_weights
from asysplat.runs.runs import find_runs
from asysplat.training.run_folder import locked

SIZE = SceneOptions(24, 32)


@pytest.fixture(scope="module")
def views():
    scene = ProceduralScene(seed=1, height=24, width=32, num_images=4)
    return replace(scene.views(range(4)), depths=None)


@pytest.fixture
def scene(views, tmp_path):
    write_transforms(views, tmp_path / "scene")
    return tmp_path / "scene"


NUMBERS = {"5,000 digits": "9" * 5000, "10^400": "1" + "0" * 400, "1e400": "1e400"}


@pytest.mark.parametrize("key", ["w", "fl_x", "cx"])
@pytest.mark.parametrize("number", NUMBERS)
def test_numbers_beyond_a_float_are_refused_with_the_file_s_name(scene, key, number):
    edit(scene, **{key: "here"}, text=('"here"', NUMBERS[number]))
    with pytest.raises(InputError, match=r"transforms\.json"):
        open_scene(scene, SIZE).views([0])


@pytest.mark.parametrize("values", [{"k1": 1e300}, {"cx": 1e30}, {"fl_x": 1e30, "fl_y": 1e30}])
def test_impossible_lenses_are_refused_with_the_file_s_name(scene, values):
    edit(scene, **values)
    with pytest.raises(InputError, match=r"transforms\.json"):
        open_scene(scene, SIZE).views([0]).validate()


def test_nesting_too_deep_for_python_is_refused_with_the_file_s_name(scene):
    (scene / "transforms.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match=r"transforms\.json"):
        open_scene(scene, SIZE)


def test_file_names_longer_than_any_file_s_are_refused(scene):
    frames = json.loads((scene / "transforms.json").read_text())["frames"]
    edit(scene, frames=[frame | {"file_path": "a" * 300 + ".png"} for frame in frames])
    with pytest.raises(InputError, match="aaa"):
        open_scene(scene, SIZE)


def edit(scene, text=("", ""), **values):
    """Set values of transforms.json, and then replace text; lenses may be those of frames."""
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    lenses = {key: value for key, value in values.items() if key != "frames"}
    content = content | values
    content["frames"] = [frame | lenses for frame in content["frames"]]
    file.write_text(json.dumps(content).replace(*text) if text[0] else json.dumps(content))


def test_an_npy_header_that_is_no_python(tmp_path, views):
    header = b"(" * 118
    (tmp_path / "poses_bounds.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    )
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match=r"poses_bounds\.npy"):
        open_scene(tmp_path, SIZE)


def test_ply_elements_that_no_disk_holds(tmp_path):
    lines = ["ply", "format binary_little_endian 1.0", f"element camera {10**15}"]
    lines += ["property float x", "element vertex 1", "property float x", "end_header", ""]
    (tmp_path / "scene.ply").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"scene\.ply"):
        read_gaussians(tmp_path / "scene.ply")


def test_splats_without_a_rotation(tmp_path):
    row = np.ones(6, np.float32).tobytes() + bytes([255] * 4) + bytes([128] * 4)
    (tmp_path / "scene.splat").write_bytes(row)
    with pytest.raises(InputError, match=r"scene\.splat"):
        read_gaussians(tmp_path / "scene.splat").validate()


def test_one_message_lists_some_of_many_errors():
    bad = BadImages()
    for number in range(100_000):
        with bad.collect():
            raise InputError(f"image {number} is missing")
    with pytest.raises(InputError) as raised:
        bad.report("scene", 0)
    assert len(str(raised.value)) < 5000 and "and 99950 more" in str(raised.value)


def test_half_precision_is_refused_by_adam():
    with pytest.raises(InputError, match="give float32 or float64"):
        SelectiveAdam({"means": torch.zeros(3, 3, dtype=torch.float16)})


def test_a_bit_of_the_weights_to_start_from(tmp_path):
    module, file = nn.Linear(64, 64), tmp_path / "last.ckpt"
    torch.save({"state_dict": module.state_dict()}, file)
    content = bytearray(file.read_bytes())
    content[content.index(module.weight[0, 0].detach().numpy().tobytes())] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"init_path=.* is damaged"):
        load_weights(str(file), module)


def test_parts_of_a_killed_write_are_removed(tmp_path):
    part = tmp_path / "stage1/checkpoints/.next.last.ckpt"
    part.parent.mkdir(parents=True)
    part.touch()
    with locked(tmp_path):
        assert not part.exists()


def test_a_reconstruction_is_no_run(tmp_path):
    (tmp_path / "scene.safetensors").touch()
    (tmp_path / "metrics.json").write_text("{}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(find_runs(tmp_path)) == []


@pytest.mark.medium
def test_arguments_are_named_as_the_caller_does(views):
    with pytest.raises(InputError, match="checkpoint=shiped does not exist"):
        load("shiped")
    with pytest.raises(InputError, match="did you mean model"):
        check_overrides(["modle=asysplat_4m4s"])
    net = load(None, ["model=asysplat_4m4s", "width=0.0625", "state_size=4"])
    cameras = views.cameras.resized(100, 130)
    odd = replace(views, cameras=cameras, images=torch.zeros(4, 3, 100, 130))
    with pytest.raises(InputError, match="100x130") as raised:
        net(odd)
    assert "data.height" not in str(raised.value)


@pytest.mark.parametrize("change", [255.0, float("nan")])
def test_refine_checks_photographs(make_scene, change):
    scene, cameras = make_scene(views=2, dtype=torch.float32)
    images = torch.full((2, 3, 13, 17), 0.5) * change
    with pytest.raises(InputError, match=r"images"):
        refine(scene, asysplat.Views(cameras, images), steps=1)


COMMANDS = {
    "report.py output={file}/report": "output",
    "train.py paths.logs={file}/logs": "paths.logs",
    "evaluate.py gaussians={scene}": "add data=files",
    "reconstruct.py {photographs} height=abc": "height=abc",
    "reconstruct.py {bare} paths.logs={empty}": "found cameras for 0 of 4",
}


ALONE = "reconstruct.py {photographs} height=abc"  # which the tests' type checks refuse


@pytest.mark.medium
@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_command_ends_with_a_sentence_and_status_1(
    run_script, repository, scene, tmp_path, make_scene, command
):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare").symlink_to(scene / "images")
    gaussians, _ = make_scene(dtype=torch.float32)
    asysplat.write_gaussians(tmp_path / "scene.ply", gaussians)
    places = {name: tmp_path / name for name in ("file", "empty", "bare")}
    places |= {"photographs": scene, "scene": tmp_path / "scene.ply"}
    words = command.format(**places).split()
    if command == ALONE:
        words = [sys.executable, *words]
        result = subprocess.run(words, cwd=repository, capture_output=True, text=True)
    else:
        result = run_script(*words)
    assert result.returncode == 1 and COMMANDS[command] in result.stderr, result.stderr
    assert "Traceback" not in result.stderr


def test_photographs_that_cannot_be_opened_as_asked_are_refused(scene, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, options, message in (
        (scene, {"layout": "colmp"}, "colmp"),
        (scene, {"max_held_out": 0}, "max_held_out=0"),
        (tmp_path / "empty", {}, "camera poses"),
    ):
        with pytest.raises(InputError, match=message):
            asysplat.open_photographs(folder, height=24, **options)


def test_a_height_above_the_photographs_is_lowered_to_theirs(scene):
    said = []
    opened = asysplat.open_photographs(scene, height=3000, views=2, say=said.append)
    assert opened.inputs.cameras.height == 24
    assert "height=3000: the photographs have 24 pixels, which are used." in said


def test_as_many_photographs_as_memory_holds(scene, monkeypatch):
    options = {"height": 24, "views": None, "held_out_every": None}
    assert asysplat.open_photographs(scene, **options).inputs.num_views == 4
    monkeypatch.setattr(photographs, "MAX_BYTES", 3 * 24 * 32 * photographs.BYTES_PER_PIXEL)
    assert asysplat.open_photographs(scene, **options).inputs.num_views == 3


@pytest.mark.medium
@pytest.mark.parametrize("script", ["train", "reconstruct", "evaluate", "report"])
def test_a_typo_is_named_before_torch_is_imported(repository, script):
    program = f"""
import runpy, sys
sys.argv = ["{script}.py", "pathz.logs=x"]
try:
    runpy.run_path("{script}.py", run_name="__main__")
except SystemExit as end:
    assert "pathz.logs is unknown" in str(end.code), end.code
    print("torch" in sys.modules)
"""
    words = [sys.executable, "-c", program]
    result = subprocess.run(words, cwd=repository, capture_output=True, text=True)
    assert result.stdout == "False\n", result.stderr


def test_help_begins_with_lines_that_work(repository, scene, tmp_path):
    _, lines = asysplat.__doc__.split("\n\n")
    lines = lines.replace("my_scene", str(scene)).replace("scene.ply", str(tmp_path / "scene.ply"))
    lines = lines.replace("128", "64").replace("views=8", "views=2").replace("10.0", "0.1")
    exec(lines, {"asysplat": asysplat})
    assert read_gaussians(tmp_path / "scene.ply").num_gaussians > 0
