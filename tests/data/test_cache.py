"""The cache returns the same pixels, within bounds, and never those of another file."""

import numpy as np
import pytest
import torch

from asysplat.data import ImageCache, ProceduralScene, SceneOptions, open_scene
from asysplat.data.cache import GIGABYTE
from asysplat.data.write import write_transforms

KILOBYTE = 1000 / GIGABYTE  # in the cache's unit


def numbers(count, seed=0):
    return np.random.default_rng(seed).integers(0, 255, count, dtype=np.uint8)


def never():
    raise AssertionError("made again")


@pytest.fixture
def scene(tmp_path):
    write_transforms(ProceduralScene(1, 24, 32).views(range(3)), tmp_path / "s")
    return tmp_path / "s"


def test_cached_arrays_are_made_once(tmp_path):
    array = numbers(100)
    cache = ImageCache(tmp_path / "cache")
    assert np.array_equal(cache.get("ab", lambda: array, to_disk=True), array)
    assert np.array_equal(cache.get("ab", never, to_disk=True), array)
    # Another process reads it from disk, but not an array of memory alone.
    other = ImageCache(tmp_path / "cache")
    assert np.array_equal(other.get("ab", never, to_disk=True), array)
    cache.get("cd", lambda: array, to_disk=False)
    with pytest.raises(AssertionError):
        other.get("cd", never, to_disk=True)


def test_memory_is_bounded_and_the_least_recently_used_goes_first(tmp_path):
    cache = ImageCache(None, memory_gb=2.5 * KILOBYTE)
    for key in ("a", "b"):
        cache.get(key, lambda: numbers(1000), to_disk=True)
    cache.get("a", never, to_disk=True)
    cache.get("c", lambda: numbers(1000), to_disk=True)
    cache.get("a", never, to_disk=True)
    with pytest.raises(AssertionError):
        cache.get("b", never, to_disk=True)


def test_the_disk_is_bounded(tmp_path):
    folder = tmp_path / "cache"
    cache = ImageCache(folder, disk_gb=10 * KILOBYTE, memory_gb=0)
    others = [folder / "ab" / "abcd.npy", folder / "ab" / f"{1:032x}-{0:016x}.npy"]
    others[0].parent.mkdir(parents=True)
    for file in others:
        np.save(file, numbers(1000))
    for index in range(40):
        cache.get(f"{index:032x}-{0:016x}", lambda: numbers(1000), to_disk=True)
    left = [path.stat().st_size for path in folder.rglob("*.npy") if path not in others]
    assert 5_000 < sum(left) <= 10_000
    cache.get(f"{39:032x}-{0:016x}", never, to_disk=True)
    assert all(file.exists() for file in others)


def test_a_file_that_is_cut_short_is_made_again(tmp_path):
    array = numbers(100)
    ImageCache(tmp_path).get("abcd", lambda: array, to_disk=True)
    (file,) = tmp_path.rglob("*.npy")
    file.write_bytes(file.read_bytes()[:50])
    cache = ImageCache(tmp_path)
    assert np.array_equal(cache.get("abcd", lambda: array, to_disk=True), array)
    assert np.array_equal(ImageCache(tmp_path).get("abcd", never, to_disk=True), array)


def test_views_are_the_same_with_a_cache(scene, tmp_path):
    """Images and depths; those at their stored size are not stored twice."""
    for height, width, files in [(24, 32, 0), (12, 16, 6), (12, 16, 6), (12, 12, 12), (6, 8, 18)]:
        plain = open_scene(scene, SceneOptions(height, width)).views(range(3))
        cache = ImageCache(tmp_path / "cache")
        cached = open_scene(scene, SceneOptions(height, width, cache=cache)).views(range(3))
        assert torch.equal(cached.images, plain.images)
        assert torch.equal(cached.depths, plain.depths)
        assert len(list((tmp_path / "cache").rglob("*.npy"))) == files


def test_an_image_that_changes_is_read_again(scene, tmp_path):
    cache = ImageCache(tmp_path / "cache")
    before = open_scene(scene, SceneOptions(12, 16, cache=cache)).views([0, 1])
    first, second = (scene / f"images/0000{index}.png" for index in (0, 1))
    first.write_bytes(second.read_bytes())
    after = open_scene(scene, SceneOptions(12, 16, cache=cache)).views([0, 1])
    assert not torch.equal(before.images[0], before.images[1])
    assert torch.equal(after.images[0], before.images[1])
