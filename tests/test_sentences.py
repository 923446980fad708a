"""What files, arguments and commands may hold by mistake ends with a sentence that names it."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

import asysplat
from asysplat import load, read_gaussians, refine
from asysplat.__main__ import COMMANDS as COMMANDS_OF_THE_PROJECT
from asysplat.data import ProceduralScene, SceneOptions, photographs
from asysplat.data.bad_images import BadImages
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.refinement.adam import SelectiveAdam
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


def test_parts_of_a_killed_write_are_removed(tmp_path):
    part = tmp_path / "stage1/checkpoints/.next.last.ckpt"
    part.parent.mkdir(parents=True)
    part.touch()
    with locked(tmp_path):
        assert not part.exists()


@pytest.mark.medium
def test_arguments_are_named_as_the_caller_does(views):
    with pytest.raises(InputError, match="checkpoint=shiped does not exist"):
        load("shiped")
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
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare").symlink_to(scene / "images")
    gaussians, _ = make_scene(dtype=torch.float32)
    asysplat.write_gaussians(tmp_path / "scene.ply", gaussians)
    places = {name: tmp_path / name for name in ("empty", "bare")}
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


def test_as_many_photographs_as_memory_holds(scene):
    said, one = [], 24 * 32 * photographs.BYTES_PER_PIXEL / 1e9
    options = {"height": 24, "views": None, "held_out_every": None, "say": said.append}
    assert asysplat.open_photographs(scene, **options).inputs.num_views == 4
    measuring = photographs.MEASURING * one
    some = asysplat.open_photographs(scene, **options, max_gb=3.5 * one + measuring)
    assert some.inputs.num_views == 3
    assert "3 of 4 photographs are used: memory_gb= holds no more." in said
    with pytest.raises(InputError, match=r"^memory_gb leaves .* of which two of 24x32 pixels take"):
        asysplat.open_photographs(scene, **options, max_gb=1.5 * one + measuring)


MISTAKES = {
    "train pathz.logs=x": "override 'pathz.logs': did you mean paths.logs",
    "report cots=true": "did you mean costs",
    "reconstruct /nonexistent": "/nonexistent does not exist",
    "check /nonexistent": "/nonexistent does not exist",
}


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_named_before_torch_is_imported(repository, command):
    name, *words = command.split()
    target = COMMANDS_OF_THE_PROJECT[name][0]
    run = "run_path" if target.endswith(".py") else "run_module"
    program = f"""
import runpy, sys
sys.argv = {[target, *words]}
try:
    runpy.{run}({target!r}, run_name="__main__")
except SystemExit as end:
    print(end.code, file=sys.stderr)
print(sorted({{"torch", "lightning", "numba"}} & set(sys.modules)))
"""
    words = [sys.executable, "-c", program]
    result = subprocess.run(words, cwd=repository, capture_output=True, text=True)
    assert MISTAKES[command] in result.stderr
    assert result.stdout == "[]\n", result.stderr


# Each takes as long to import as torch.
HEAVY = {"lightning", "torchmetrics", "torchvision"}


def test_only_training_and_evaluation_import_lightning(repository):
    modules = []
    for name in ("reconstruct", "report", "export", "check", "view", "cameras"):
        target = COMMANDS_OF_THE_PROJECT[name][0].removesuffix(".py")
        folder = repository / target.replace(".", "/")
        modules.append(f"{target}.__main__" if folder.is_dir() else target)
    program = f"import sys, {', '.join(modules)}; print(sorted({HEAVY} & set(sys.modules)))"
    words = [sys.executable, "-c", program]
    result = subprocess.run(words, cwd=repository, capture_output=True, text=True)
    assert result.stdout == "[]\n", result.stderr


def test_help_begins_with_lines_that_work(scene, tmp_path):
    _, lines = asysplat.__doc__.split("\n\n")
    lines = lines.replace("my_scene", str(scene)).replace("scene.ply", str(tmp_path / "scene.ply"))
    lines = lines.replace("128", "64").replace("views=8", "views=2").replace("10.0", "0.1")
    exec(lines, {"asysplat": asysplat})
    assert read_gaussians(tmp_path / "scene.ply").num_gaussians > 0
