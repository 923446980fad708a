"""ScanNet++: <scene>/iphone with ARKit's poses, or <scene>/dslr with transforms."""

import json

import numpy as np

from layouts import AXES, pinholes, poses, save_depth, save_image

SCENE = "036bce3393"
# As the toolkit turns COLMAP's world, which is the scan's.
WORLD = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def write(views, folder):
    write_iphone(views, folder / SCENE / "iphone")
    return folder


def write_iphone(views, iphone):
    frames = {}
    numbers = zip(poses(views), views.cameras.intrinsics.tolist(), strict=True)
    for index, (pose, matrix) in enumerate(numbers):
        name = f"frame_{index:06d}"
        save_image(iphone / f"rgb/{name}.jpg", views.images[index])
        if views.depths is not None:
            save_depth(iphone / f"depth/{name}.png", views.depths[index])
        frames[name] = {
            "timestamp": index / 60,
            "pose": np.eye(4).tolist(),  # in ARKit's own world
            "intrinsic": matrix,
            "aligned_pose": pose.tolist(),
        }
    (iphone / "pose_intrinsic_imu.json").write_text(json.dumps(frames, indent=1))


def write_dslr(views, dslr, lens=None, test=(), masks=None):
    """Of a pinhole without `lens`, else the fisheye's images; frames `test` are test frames."""
    kind = "resized" if lens else "resized_undistorted"
    split = {False: [], True: []}
    for index, pose in enumerate(poses(views)):
        name = f"DSC{index + 1:05d}"
        save_image(dslr / f"{kind}_images/{name}.JPG", views.images[index])
        matrix = (WORLD @ pose @ AXES).tolist()
        frame = {"file_path": f"{name}.JPG", "mask_path": f"{name}.png", "is_bad": False}
        split[index in test].append({**frame, "transform_matrix": matrix})
        if masks is not None:
            save_image(dslr / f"{kind}_{'anon_' * bool(lens)}masks/{name}.png", masks[index])
    fx, fy, cx, cy = pinholes(views)[0]
    model = {"camera_model": "OPENCV_FISHEYE", **lens} if lens else {"camera_model": "PINHOLE"}
    content = {
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy},
        **{"w": views.cameras.width, "h": views.cameras.height},
        **model,
        **{"has_mask": masks is not None, "frames": split[False], "test_frames": split[True]},
    }
    file = dslr / "nerfstudio" / ("transforms.json" if lens else "transforms_undistorted.json")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content, indent=4))
