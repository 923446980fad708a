import numpy as np
import pytest
from layouts import assert_listed, opener
from layouts import posed as layout

from asysplat.data.readers import without_cameras
from asysplat.errors import InputError

open_posed = opener("posed")


@pytest.fixture
def scene(views, tmp_path):
    return layout.write(views, tmp_path)


def test_refined_poses_are_preferred_and_depth_may_be_absent(scene):
    poses = np.loadtxt(scene / "poses.txt")
    poses[:, 3] += 1
    np.savetxt(scene / "poses_refined.txt", poses)
    (scene / "depth").rename(scene / "sensor")
    views = open_posed(scene).views(range(12))
    np.testing.assert_allclose(views.cameras.centers[:, 0], poses[:, 3], atol=1e-6)
    assert views.depths is None


def test_bad_poses_are_listed_or_left_out(scene):
    poses = np.loadtxt(scene / "poses.txt")
    poses[4, 0] = np.nan
    poses[5] *= 2
    np.savetxt(scene / "poses.txt", poses)
    messages = ("pose 4 (00004.png) is not 4x4 or holds NaN", "pose 5 (00005.png) has last row")
    assert_listed(open_posed, scene, *messages, total=12)


def test_poses_and_intrinsics_that_cannot_be_used_are_refused(scene):
    poses, intrinsics = (scene / name for name in ("poses.txt", "K.txt"))
    intrinsics.write_text("-" + intrinsics.read_text())
    with pytest.raises(InputError, match="has focal lengths -"):
        open_posed(scene)
    poses.write_text(poses.read_text()[:-200])
    with pytest.raises(InputError, match="number of columns changed"):
        open_posed(scene)


def test_missing_images_and_poses_are_refused(scene):
    (scene / "images/00003.png").unlink()
    with pytest.raises(InputError, match=r"poses\.txt has 12 poses and .*images 11 images"):
        open_posed(scene)
    assert without_cameras(scene) is None
    (scene / "poses.txt").unlink()
    with pytest.raises(InputError, match=r"poses\.txt not found"):
        open_posed(scene)
    assert without_cameras(scene) == "11 photographs"  # K.txt alone is no pose
