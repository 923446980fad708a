import errno
import os
from concurrent.futures import ThreadPoolExecutor

import pytest
from full_disk import largest_file

from asysplat.errors import InputError
from asysplat.files import atomic_write, check_writable, new_folder, refuse_links


@pytest.fixture
def old(tmp_path):
    file = tmp_path / "scene.ply"
    file.write_text("old")
    return file


def assert_untouched(file):
    assert file.read_text() == "old"
    assert list(file.parent.iterdir()) == [file]


def test_a_new_file_and_one_in_place_of_another(tmp_path):
    file = tmp_path / "scene.ply"
    for content in ("first", "second"):
        with atomic_write(file) as partial:
            assert partial.parent == tmp_path and partial.suffix == ".ply"
            partial.write_text(content)
            assert not file.exists() or file.read_text() == "first"
        assert file.read_text() == content
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_write_leaves_the_old_file(old, error):
    with pytest.raises(error), atomic_write(old) as partial:
        partial.write_text("half")
        raise error
    assert_untouched(old)


def full(descriptor):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("when", ["written", "flushed"])
def test_a_full_disk_leaves_the_old_file(old, monkeypatch, when):
    limit, reason = (1000, "File too large") if when == "written" else (10**6, "No space left")
    if when == "flushed":
        monkeypatch.setattr(os, "fsync", full)
    with (
        largest_file(limit),
        pytest.raises(InputError, match=rf"scene\.ply cannot be written \({reason}"),
        atomic_write(old) as partial,
    ):
        partial.write_bytes(bytes(2000))
    assert_untouched(old)


def test_folders_and_devices_are_refused(tmp_path):
    with pytest.raises(InputError, match="is a folder or a device"), atomic_write(tmp_path):
        raise AssertionError("never reached")


def test_permissions_stay(old):
    old.chmod(0o640)
    with atomic_write(old) as partial:
        partial.write_text("new")
    assert old.read_text() == "new" and old.stat().st_mode & 0o777 == 0o640


def test_nothing_is_written_through_a_link(old, tmp_path):
    link, content = tmp_path / "link.ply", old.read_text()
    link.symlink_to(old)
    with pytest.raises(InputError, match=r"link\.ply is a link, and .* is written to"):
        refuse_links(tmp_path)
    with atomic_write(link) as partial:
        partial.write_text("new")
    assert not link.is_symlink() and link.read_text() == "new" and old.read_text() == content
    refuse_links(tmp_path)
    (tmp_path / "figures").symlink_to(tmp_path.parent)
    with pytest.raises(InputError, match="figures is a link"):
        refuse_links(tmp_path)


def test_folders_of_many_at_once_are_different(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: new_folder(tmp_path / "logs" / "run"), range(40)))
    assert len(set(folders)) == 40 and tmp_path / "logs" / "run-40" in folders


def test_a_check_leaves_the_disk_as_it_is(tmp_path):
    check_writable(tmp_path / "new" / "logs", "paths.logs")
    assert not list(tmp_path.iterdir())
    check_writable(tmp_path, "paths.logs")
    (tmp_path / "file").touch()
    with pytest.raises(
        InputError, match=r"cannot be written to \(Not a directory\): set output to"
    ):
        check_writable(tmp_path / "file" / "new", "output")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


UNWRITABLE = {
    "train": ["paths.logs=README.md/x"],
    "reconstruct": ["tests", "paths.logs=README.md/x"],
    "evaluate": ["model=plane_sweep", "paths.logs=README.md/x"],
    "benchmark": ["suite=bench", "output=README.md/x"],
}


@pytest.mark.medium
@pytest.mark.parametrize("script", UNWRITABLE)
def test_scripts_find_a_folder_that_cannot_be_written_to_first(run_script, script):
    result = run_script(f"{script}.py", *UNWRITABLE[script])
    option = UNWRITABLE[script][-1].partition("=")[0]
    assert f"(Not a directory): set {option} to another folder." in result.stderr
    assert result.returncode != 0 and not result.stdout
