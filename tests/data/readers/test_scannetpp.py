import json
import warnings

import numpy as np
import pytest
import torch
from layouts import save_depth, save_image
from layouts.scannetpp import SCENE, write_dslr, write_iphone

from asysplat.data import SceneOptions, open_scene
from asysplat.data.readers import scannetpp
from asysplat.errors import InputError

FISHEYE = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001}


@pytest.fixture
def few(views):
    return views.select(range(4))


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


def opened(path, height=24, width=32, **options):
    return open_scene(path, SceneOptions(height, width, layout="scannetpp", **options))


def same(found, expected):
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def edit(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_the_undistorted_dslr_stands_for_a_scene(few, iphone, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    scene = dslr.parent
    undistorted = dslr / "nerfstudio/transforms_undistorted.json"
    for named in (scene, scene.parent, dslr, undistorted):
        assert scannetpp.find_scenes(named) == [undistorted]
    arkit = iphone / "pose_intrinsic_imu.json"
    assert scannetpp.find_scenes(iphone) == scannetpp.find_scenes(arkit) == [arkit]
    assert opened(scene).name == f"{SCENE}-dslr" and opened(iphone).name == f"{SCENE}-iphone"


def test_poses_with_images_come_before_those_without(few, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    (dslr / "resized_undistorted_images").rename(dslr / "elsewhere")
    assert scannetpp.find_scenes(dslr) == [dslr / "nerfstudio/transforms.json"]


def test_other_files_and_folders_hold_no_scene(dslr, tmp_path):
    other = tmp_path / "transforms.json"
    other.write_text("{}")
    assert scannetpp.find_scenes(other) == []
    with pytest.raises(InputError, match="holds 0 scenes"):
        opened(dslr / "nerfstudio")


def test_both_cameras_stand_in_the_scan_s_world(few, iphone, dslr):
    expected = few.cameras.cam_to_world
    same(opened(iphone).cameras.cam_to_world, expected)
    same(opened(dslr).cameras.cam_to_world, expected)


def test_the_dslr_s_pictures_and_cameras(few, dslr):
    read = opened(dslr).views(range(4))
    same(read.images, few.images)
    same(read.cameras.intrinsics[0], few.cameras.intrinsics[0])
    assert read.depths is None and read.masks is None


def test_the_iphone_s_colmap_comes_before_arkit(few, iphone):
    """In the toolkit's form, for some frames, and with the DSLR's as those to predict."""
    other = iphone.parent / "other"
    write_dslr(few.select([3, 0, 1]), other, test=[2])

    def rename(content):
        del content["has_mask"]
        for frame, name in zip(content["frames"], ("frame_000003", "frame_000000"), strict=True):
            frame["file_path"] = f"{name}.jpg"

    edit(other / "nerfstudio/transforms_undistorted.json", rename)
    file = iphone / "nerfstudio/transforms.json"
    file.parent.mkdir()
    (other / "nerfstudio/transforms_undistorted.json").rename(file)
    assert scannetpp.find_scenes(iphone) == [file]
    read = opened(iphone).views([0, 1])
    same(read.cameras.cam_to_world, few.cameras.cam_to_world[[0, 3]])
    same(read.images, few.images[[0, 3]])
    same(read.depths, few.depths[[0, 3]])


def test_fisheye_is_undistorted(few, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    sequence = opened(dslr / "nerfstudio/transforms.json")
    lens = sequence.scene.images[0].lens
    assert lens.fisheye and lens.distortion == tuple(FISHEYE.values())
    assert sequence.views([0]).masks is not None


def test_rendered_depths_belong_to_the_fisheye(few, dslr):
    write_dslr(few, dslr, lens=FISHEYE)
    for index in range(4):
        save_depth(dslr / f"render_depth/DSC{index + 1:05d}.png", torch.full((24, 32), 1.5))
    depths = opened(dslr / "nerfstudio/transforms.json").views([0]).depths
    same(depths[0, 12, 16], torch.tensor(1.5))
    assert opened(dslr).views([0]).depths is None


def test_lidar_is_smaller_and_in_millimetres(iphone):
    for index in range(4):
        save_depth(iphone / f"depth/frame_{index:06d}.png", torch.full((6, 8), 2.125))
    assert opened(iphone).views([0]).depths.unique().tolist() == [2.125]


def test_masks_are_read(few, dslr, iphone):
    masks = torch.ones(4, 3, 24, 32)
    masks[:, :, :5, :7] = 0
    write_dslr(few, dslr, masks=masks)
    for index, mask in enumerate(masks):
        save_image(iphone / f"rgb_masks/frame_{index:06d}.png", mask)
    for folder in (dslr, iphone):
        assert torch.equal(opened(folder).views(range(4)).masks, masks[:, 0] > 0)


def test_published_test_frames_are_among_the_photographs(few, dslr):
    write_dslr(few, dslr, test=[1, 3])
    sequence = opened(dslr)
    same(sequence.cameras.cam_to_world, few.cameras.cam_to_world)
    for name in ("DSC00002.JPG", "DSC00004.JPG"):
        (dslr / "resized_undistorted_images" / name).unlink()
    hidden = opened(dslr)
    same(hidden.cameras.cam_to_world, few.cameras.cam_to_world[[0, 2]])


def test_one_missing_test_frame_is_a_bad_frame(few, dslr):
    write_dslr(few, dslr, test=[1, 3])
    (dslr / "resized_undistorted_images/DSC00002.JPG").unlink()
    with pytest.raises(InputError, match=r"1 of 4 images(.|\n)*DSC00002.JPG does not exist"):
        opened(dslr)


def test_frames_that_the_data_set_marks_are_left_out_and_told(few, dslr):
    def mark(content):
        content["frames"][1]["is_bad"] = True

    edit(dslr / "nerfstudio/transforms_undistorted.json", mark)
    with pytest.warns(UserWarning, match="left out 1 of 4 images that the data set marks is_bad"):
        assert opened(dslr).num_images == 3


def test_sparse_points_are_kept(dslr):
    (dslr / "colmap").mkdir()
    (dslr / "colmap/points3D.txt").write_text(
        "# 3D point list\n7 1.5 -2 3 255 0 0 0.5 1 2 3 4\n9 0 0.25 1e-3 1 2 3 0.1 1 1\n"
    )
    scene = opened(dslr).scene
    assert np.array_equal(scene.points, [[1.5, -2, 3], [0, 0.25, 1e-3]])


def test_points_that_are_cut_short_are_named(dslr):
    (dslr / "colmap").mkdir()
    (dslr / "colmap/points3D.txt").write_text("7 1.5 -2 3 255 0 0 0.5 1 2\n9 0 0.25\n")
    with pytest.raises(InputError, match=r"points3D.txt cannot be read"):
        _ = opened(dslr).scene.points


def set_arkit(name, **values):
    def damage(iphone):
        edit(iphone / "pose_intrinsic_imu.json", lambda content: content[name].update(values))

    return damage


def cut(iphone):
    image = iphone / "rgb/frame_000002.jpg"
    image.write_bytes(image.read_bytes()[:300])


THIRD = "frame_000002"
FRAMES = {
    "missing": (lambda iphone: (iphone / f"rgb/{THIRD}.jpg").unlink(), "002.jpg does not exist"),
    "cut short": (cut, "002.jpg cannot be read"),
    "missing depth": (
        lambda iphone: (iphone / f"depth/{THIRD}.png").unlink(),
        "002.png does not exist",
    ),
    "depth of other proportions": (
        lambda iphone: save_depth(iphone / f"depth/{THIRD}.png", torch.ones(8, 8)),
        "002.png is 8 x 8 and the image 32 x 24",
    ),
    "no pose": (set_arkit(THIRD, aligned_pose=None), f"{THIRD}: aligned_pose is not 4x4"),
    "nan": (
        set_arkit(THIRD, aligned_pose=(np.eye(4) * np.nan).tolist()),
        f"{THIRD}: aligned_pose holds NaN",
    ),
    "intrinsic": (set_arkit(THIRD, intrinsic=[[1, 2], [3]]), f"{THIRD}: intrinsic is"),
    "focal length": (
        set_arkit(THIRD, intrinsic=np.diag([0.0, 1, 1]).tolist()),
        f"{THIRD}: intrinsic is",
    ),
}


@pytest.mark.parametrize("damage, message", FRAMES.values(), ids=FRAMES.keys())
def test_a_bad_frame_is_named_or_left_out(iphone, damage, message):
    damage(iphone)
    with pytest.raises(InputError, match=f"1 of 4 images cannot be used(.|\n)*{message}"):
        opened(iphone)
    with pytest.warns(UserWarning, match=f"left out 1 of 4 images(.|\n)*{message}"):
        assert opened(iphone, on_bad_image="skip").num_images == 3


def test_a_frame_without_numbers_is_a_bad_frame(iphone):
    edit(iphone / "pose_intrinsic_imu.json", lambda content: content.update({THIRD: None}))
    with pytest.raises(InputError, match=f"{THIRD} is None"):
        opened(iphone)


def test_frames_that_were_not_extracted_are_said_to_be(iphone):
    (iphone / "rgb").rename(iphone / "frames")
    (iphone / "rgb.mkv").write_bytes(b"")
    with pytest.raises(InputError, match=r"rgb does not exist: extract rgb.mkv .*ffmpeg"):
        opened(iphone)


def test_masks_that_were_not_downloaded_are_told_once(few, dslr):
    edit(
        dslr / "nerfstudio/transforms_undistorted.json",
        lambda content: content.update(has_mask=True),
    )
    with pytest.raises(InputError, match="resized_undistorted_masks does not exist"):
        opened(dslr)


def test_a_file_that_is_no_object_is_refused(iphone):
    (iphone / "pose_intrinsic_imu.json").write_text("[]")
    with pytest.raises(InputError, match="is no object of frames"):
        opened(iphone)


def test_whole_scenes_give_no_warning(iphone, dslr):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(iphone), opened(dslr)
