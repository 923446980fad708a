"""`asysplat check`: output, files and exit codes."""

import json
import shutil

import pytest
from PIL import Image

from asysplat.data import ProceduralScene
from asysplat.data.check.__main__ import main, read_arguments
from asysplat.data.write import write_transforms

HEIGHT, WIDTH, COUNT = 160, 240, 12


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "walk"
    scene = ProceduralScene(4, HEIGHT, WIDTH, COUNT)
    write_transforms(scene.views(range(COUNT)), folder)
    return folder


@pytest.fixture
def scene(written, tmp_path):
    """A copy that a test may damage."""
    return shutil.copytree(written, tmp_path / "data/walk")


@pytest.fixture
def check(tmp_path, monkeypatch, capsys):
    """Runs the command; returns exit code, output and errors."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)

    def run(*arguments) -> tuple[int, str, str]:
        try:
            code = main(read_arguments([str(argument) for argument in arguments]))
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


def edit(scene, change) -> None:
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def damage(image) -> None:
    """Damage the middle: the size can be read, the pixels cannot."""
    data = bytearray(image.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    image.write_bytes(data)


@pytest.fixture
def no_figure(monkeypatch):
    """Figures take longer than all else."""
    monkeypatch.setattr("asysplat.data.check.__main__.save_figure", lambda *_: "check.png")


@pytest.mark.medium
def test_the_report_of_a_good_scene_fits_one_screen_and_overwrites_nothing(check, scene, tmp_path):
    folder = tmp_path / "elsewhere/walk"
    folder.mkdir(parents=True)
    (folder / "check.png").write_text("mine")
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    code, out, err = check(scene, "--out", tmp_path / "elsewhere")
    assert code == 0 and not err
    assert len(out.splitlines()) < 24
    for text in (
        *("walk, layout transforms", f"{COUNT} of {WIDTH} x {HEIGHT}", "known at 100.0%"),
        *("The cameras fit the images.", "masks           none", "points          none"),
        "elsewhere/walk/check-2.png",
    ):
        assert text in out
    assert {path: path.stat().st_mtime_ns for path in scene.rglob("*")} == before
    assert (folder / "check.png").read_text() == "mine"
    assert sorted(path.name for path in folder.iterdir()) == ["check-2.png", "check.png"]
    with Image.open(folder / "check-2.png") as figure:
        assert min(figure.size) > 500 and len(figure.getcolors(2**20)) > 1000


@pytest.mark.medium
@pytest.mark.usefixtures("no_figure")
def test_a_mistake_exits_with_1_and_its_fix(check, scene):
    def unflip(content):
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[1], row[2] = -row[1], -row[2]

    edit(scene, unflip)
    code, out, _ = check(scene)
    assert code == 1
    assert "OpenGL axes were taken for OpenCV's" in out and "right, up, backward" in out


@pytest.mark.medium
@pytest.mark.usefixtures("no_figure")
def test_all_damaged_files_and_a_wrong_depth_unit_are_reported(check, scene):
    damage(scene / "images/00003.png")
    damage(scene / "images/00007.png")
    (scene / "images/00009.png").unlink()
    code, out, err = check(scene)
    assert code == 2 and "Traceback" not in err
    assert err.startswith("error: walk: 3 of 12 images cannot be used")
    assert all(name in err for name in ("00003.png", "00007.png", "00009.png"))
    edit(scene, lambda content: content.update(depth_unit_scale_factor=0.01))
    code, out, err = check(scene, "--on-error", "skip")
    assert code == 0 and out.count("left out") == 3
    assert all(name in out for name in ("00003.png", "00007.png", "00009.png"))
    assert "images          9 " in out and "divide the unit of depth by 9.9" in out


@pytest.mark.medium
def test_the_first_of_many_scenes_are_checked_also_without_a_point_to_match(check, scene):
    for image in (scene / "images").iterdir():
        Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(image)
    for name in "bcde":
        shutil.copytree(scene, scene.parent / name)
    code, out, _ = check(scene.parent)
    assert code == 1 and "Only 0 points were matched" in out
    assert "11 with the same file as another" in out
    assert "checking 3 of 5 scenes; name one of them to check another" in out
    assert [name for name in "bcde" if f"{name}, layout" in out] == ["b", "c", "d"]


@pytest.mark.medium
@pytest.mark.usefixtures("scene")
def test_errors_of_the_check_are_one_line(check):
    for arguments, message in (
        (("nowhere",), "nowhere does not exist"),
        (("data/walk", "--out", "data/walk/check"), "lies in the data set"),
    ):
        code, _, err = check(*arguments)
        assert code == 2 and message in err
        assert err.startswith("error: ") and err.count("\n") == 1
