"""The wheel has all that a user needs, in any folder."""

import os
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import version

import pytest

from asysplat.__main__ import COMMANDS
from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms

ENVIRONMENT = dict(os.environ)
pytestmark = pytest.mark.medium


def build(source, kind, folder):
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built


def contents(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if "RECORD" not in name}


@pytest.fixture(scope="module")
def wheel(repository, tmp_path_factory):
    return build(repository, "wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def run(wheel, tmp_path_factory):
    """Runs a command with the installed wheel, in a folder with nothing but a scene."""
    site, folder = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("user")
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target"]
    subprocess.run([*install, str(site), str(wheel)], check=True, capture_output=True)
    write_transforms(ProceduralScene(0, 32, 32, 10).views(range(10)), folder / "my_scene")
    ENVIRONMENT["PYTHONPATH"] = str(site)

    def run(*command):
        if command[0] == "asysplat":
            command = (sys.executable, str(site / "bin" / "asysplat"), *command[1:])
        result = subprocess.run(
            command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True
        )
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run


def test_the_source_distribution_builds_the_same_wheel(repository, wheel, tmp_path):
    sdist = build(repository, "sdist", tmp_path / "sdist")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.glob("asysplat-*")
    assert contents(build(source, "wheel", tmp_path / "wheel")) == contents(wheel)


def test_every_configuration_is_in_the_wheel(repository, wheel):
    files = repository.glob("conf/**/*.yaml")
    names = {f"asysplat/installed/{path.relative_to(repository)}" for path in files}
    assert names <= contents(wheel).keys()


def test_the_command_reconstructs_photographs(run):
    options = ("height=24", "views=4", "steps=2", "video.path=none")
    assert "scene: " in run("asysplat", "reconstruct", "my_scene", *options)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "doctor"])
def test_every_command_shows_its_options(run, name):
    assert f"asysplat {name} " in run("asysplat", name, "--help")


def test_the_doctor_names_versions_and_what_is_missing(run):
    lines = dict(line.split(maxsplit=1) for line in run("asysplat", "doctor").splitlines())
    assert lines["torch"].startswith(version("torch")) and lines["asysplat"].endswith("installed")
    assert lines["viewer"] == "asysplat view, view=true"
