"""Damaged files of every format: valid Gaussians or one sentence, in bounded memory."""

import contextlib
import ctypes
import gzip
import os
from functools import partial

import pytest
from damage import check_reader, damaged, damaged_zip, variants
from plyfile import PlyData

from asysplat import read_gaussians, write_gaussians
from asysplat.errors import InputError
from asysplat.evaluation.measured_cost import peak_memory_gb, reset_peak_memory
from asysplat.export.formats.spz import write_spz
from asysplat.export.gaussians import Notes

NAMES = ("a.ply", "text.ply", "a.compressed.ply", "2.spz", "3.spz", "4.spz", "a.sog", "a.glb")
NAMES += ("a.splat", "a.safetensors")


def write_all(folder, scene):
    """Write the scene as NAMES."""
    for name in NAMES:
        write_gaussians(folder / name, scene, Notes((1e6, 2.0, 3.0), (0.25, 0.5, 0.75)))
    for version in (2, 3, 4):
        write_spz(folder / f"{version}.spz", scene, version)
    ply = PlyData.read(folder / "a.ply")
    ply.text = True
    ply.write(folder / "text.ply")
    return folder


@pytest.fixture(scope="module")
def files(make_scene, tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("files"), make_scene(count=300, degree=2)[0])


@pytest.fixture(scope="module")
def large(make_scene, tmp_path_factory):
    return write_all(tmp_path_factory.mktemp("large"), make_scene(count=20_000)[0])


def damaged_gzip(content, random):
    """Damage what a gzip file holds, behind its checksum."""
    return gzip.compress(damaged(gzip.decompress(content), random), 1)


def kinds_of(name):
    if name.endswith(".sog"):
        return damaged, damaged_zip
    return (damaged, damaged_gzip) if name in ("2.spz", "3.spz") else (damaged,)


@pytest.mark.parametrize("count", [200, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_read_or_refused_in_one_sentence(files, tmp_path, name, count):
    contents = variants((files / name).read_bytes(), count, *kinds_of(name))
    read = partial(read_gaussians, origin=(0.0, 0.0, 0.0))
    read_count, refused = check_reader(read, tmp_path / name, contents)
    assert refused > 0.1 * count and read_count + refused == count


def peak_memory(path):
    """Bytes by which reading a file raises the resident memory of this process."""
    ctypes.CDLL(None).malloc_trim(0)  # else the read reuses what earlier ones left
    reset_peak_memory("cpu")
    before = peak_memory_gb("cpu")
    with contextlib.suppress(InputError):
        read_gaussians(path)
    return 1e9 * (peak_memory_gb("cpu") - before)


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="needs Linux's /proc")
@pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_takes_at_most_twice_the_memory_of_the_whole_one(
    large, tmp_path, name, count
):
    whole = max(peak_memory(large / name) for _ in range(3))
    assert whole > 20_000 * 14 * 4  # the Gaussians without SH
    for content in variants((large / name).read_bytes(), count, *kinds_of(name)):
        (tmp_path / name).write_bytes(content)
        assert peak_memory(tmp_path / name) < 2 * whole
