"""Damaged files of every format: valid Gaussians or one sentence, in bounded memory."""

import gzip
import tracemalloc
from functools import partial

import pytest
from damage import check_reader, damaged, damaged_zip, variants
from plyfile import PlyData

from asysplat import read_gaussians, write_gaussians
from asysplat.errors import InputError
from asysplat.export.formats.spz import write_spz
from asysplat.export.gaussians import Notes

NAMES = ("a.ply", "text.ply", "a.compressed.ply", "2.spz", "3.spz", "4.spz", "a.sog", "a.glb")
NAMES += ("a.splat", "a.safetensors")


@pytest.fixture(scope="module")
def files(make_scene, tmp_path_factory):
    folder, scene = tmp_path_factory.mktemp("files"), make_scene(count=300, degree=2)[0]
    for name in NAMES:
        write_gaussians(folder / name, scene, Notes((1e6, 2.0, 3.0), (0.25, 0.5, 0.75)))
    for version in (2, 3, 4):
        write_spz(folder / f"{version}.spz", scene, version)
    ply = PlyData.read(folder / "a.ply")
    ply.text = True
    ply.write(folder / "text.ply")
    return folder


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


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_takes_no_more_memory_than_the_whole_one(files, tmp_path, name):
    def peak(path):
        tracemalloc.start()
        try:
            read_gaussians(path)
        except InputError:
            pass
        finally:
            size = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        return size

    peak(files / name)  # imports, and caches of the first call
    whole = peak(files / name)
    for content in variants((files / name).read_bytes(), 60, *kinds_of(name)):
        (tmp_path / name).write_bytes(content)
        assert peak(tmp_path / name) < 2 * whole + 200_000
