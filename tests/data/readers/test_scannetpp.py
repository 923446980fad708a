import warnings

import numpy as np
import pytest
import torch
from layouts import assert_listed, edit_json, opener, save_depth, save_image
from layouts import assert_same as same
from layouts.scannetpp import SCENE, write_dslr, write_iphone

from asysplat.data.readers import scannetpp, scannetpp_depths
from asysplat.errors import InputError

FISHEYE = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001}
UNDISTORTED = "nerfstudio/transforms_undistorted.json"
opened = opener("scannetpp")


@pytest.fixture
def iphone(few, tmp_path):
    folder = tmp_path / "räume" / SCENE / "iphone"
    write_iphone(few, folder)
    return folder


@pytest.fixture
def dslr(few, tmp_path):
    folder = tmp_path / "räume" / SCENE / "dslr"
    write_dslr(few, folder)
    return folder


def test_the_undistorted_dslr_stands_for_a_scene(few, iphone, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    scene = dslr.parent
    undistorted = dslr / UNDISTORTED
    for named in (scene, scene.parent, dslr, undistorted):
        assert scannetpp.find_scenes(named) == [undistorted]
    arkit = iphone / "pose_intrinsic_imu.json"
    assert scannetpp.find_scenes(iphone) == scannetpp.find_scenes(arkit) == [arkit]
    assert opened(scene).name == f"{SCENE}-dslr" and opened(iphone).name == f"{SCENE}-iphone"
    # Poses without images come last.
    (dslr / "resized_undistorted_images").rename(dslr / "elsewhere")
    assert scannetpp.find_scenes(dslr) == [dslr / "nerfstudio/transforms.json"]
    other = scene.parent / "transforms.json"
    other.write_text("{}")
    assert scannetpp.find_scenes(other) == []
    with pytest.raises(InputError, match="holds 0 scenes"):
        opened(dslr / "nerfstudio")


def test_both_cameras_are_read_in_the_world_of_the_scan(few, iphone, dslr):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same(opened(iphone).cameras.cam_to_world, few.cameras.cam_to_world)
        read = opened(dslr).views(range(4))
    same(read.cameras.cam_to_world, few.cameras.cam_to_world)
    same(read.images, few.images)
    same(read.cameras.intrinsics[0], few.cameras.intrinsics[0])
    assert read.depths is None and read.masks is None


def test_the_iphone_s_colmap_poses_come_before_arkit_s(few, iphone):
    """In the toolkit's form, for some images, with the DSLR's as test frames."""
    other = iphone.parent / "other"
    write_dslr(few.select([3, 0, 1]), other, test=[2])

    def rename(content):
        del content["has_mask"]
        for frame, name in zip(content["frames"], ("frame_000003", "frame_000000"), strict=True):
            frame["file_path"] = f"{name}.jpg"

    edit_json(other / UNDISTORTED, rename)
    file = iphone / "nerfstudio/transforms.json"
    file.parent.mkdir()
    (other / UNDISTORTED).rename(file)
    assert scannetpp.find_scenes(iphone) == [file]
    read = opened(iphone).views([0, 1])
    same(read.cameras.cam_to_world, few.cameras.cam_to_world[[0, 3]])
    same(read.images, few.images[[0, 3]])
    same(read.depths, few.depths[[0, 3]])


def test_fisheye_is_undistorted_and_has_the_rendered_depths(few, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    for index in range(4):
        save_depth(dslr / f"render_depth/DSC{index + 1:05d}.png", torch.full((24, 32), 1.5))
    sequence = opened(dslr / "nerfstudio/transforms.json")
    lens, views = sequence.scene.images[0].lens, sequence.views([0])
    assert lens.model == "OPENCV_FISHEYE" and lens.distortion == tuple(FISHEYE.values())
    assert views.masks is not None
    same(views.depths[0, 12, 16], torch.tensor(1.5))
    assert opened(dslr).views([0]).depths is None


def test_where_depths_are_measured_a_scene_is_the_first_camera_that_has_some(few, iphone, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    scene, fisheye = dslr.parent, dslr / "nerfstudio/transforms.json"
    assert scannetpp_depths.find_scenes(scene.parent) == [iphone / "pose_intrinsic_imu.json"]
    assert (opener("scannetpp_depths")(scene).views([0]).depths > 0).any()
    save_depth(dslr / "render_depth/DSC00001.png", torch.full((24, 32), 1.5))
    assert scannetpp_depths.find_scenes(scene) == [fisheye]
    assert scannetpp_depths.find_scenes(fisheye) == [fisheye]
    (dslr / "render_depth").rename(dslr / "elsewhere")
    (iphone / "depth").rename(iphone / "elsewhere")
    with pytest.raises(InputError, match=r"has no depth maps.*dslr/render_depth.*iphone/depth"):
        scannetpp_depths.find_scenes(scene.parent)


def test_masks_are_read(few, dslr, iphone):
    masks = torch.ones(4, 3, 24, 32)
    masks[:, :, :5, :7] = 0
    write_dslr(few, dslr, masks=masks)
    for index, mask in enumerate(masks):
        save_image(iphone / f"rgb_masks/frame_{index:06d}.png", mask)
    for folder in (dslr, iphone):
        assert torch.equal(opened(folder).views(range(4)).masks, masks[:, 0] > 0)


def test_published_test_images_are_read(few, dslr):
    write_dslr(few, dslr, test=[1, 3])
    same(opened(dslr).cameras.cam_to_world, few.cameras.cam_to_world)
    (dslr / "resized_undistorted_images/DSC00002.JPG").unlink()
    with pytest.raises(InputError, match=r"1 of 4 images(.|\n)*DSC00002.JPG does not exist"):
        opened(dslr)
    (dslr / "resized_undistorted_images/DSC00004.JPG").unlink()
    same(opened(dslr).cameras.cam_to_world, few.cameras.cam_to_world[[0, 2]])


def test_a_warning_counts_images_that_are_marked_as_bad(few, dslr):
    def mark(content):
        content["frames"][1]["is_bad"] = True

    edit_json(dslr / UNDISTORTED, mark)
    with pytest.warns(UserWarning, match="left out 1 of 4 images that the data set marks is_bad"):
        assert opened(dslr).num_images == 3


def test_sparse_points_are_read(dslr):
    (dslr / "colmap").mkdir()
    file = dslr / "colmap/points3D.txt"
    file.write_text(
        "# 3D point list\n7 1.5 -2 3 255 0 0 0.5 1 2 3 4\n9 0 0.25 1e-3 1 2 3 0.1 1 1\n"
    )
    assert np.array_equal(opened(dslr).scene.points, [[1.5, -2, 3], [0, 0.25, 1e-3]])


def test_a_bad_pose_is_named_or_left_out(iphone):
    def damage(content):
        content["frame_000002"]["aligned_pose"] = (np.eye(4) * np.nan).tolist()

    edit_json(iphone / "pose_intrinsic_imu.json", damage)
    assert_listed(opened, iphone, "frame_000002: aligned_pose is not 4x4 or holds NaN")


def test_a_video_without_its_frames_is_refused(iphone):
    (iphone / "rgb").rename(iphone / "frames")
    (iphone / "rgb.mkv").write_bytes(b"")
    with pytest.raises(InputError, match=r"rgb does not exist: extract rgb.mkv .*ffmpeg"):
        opened(iphone)
