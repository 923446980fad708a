"""DL3DV-ALL-960P: transforms.json of the 4K video beside images_4/; or the benchmark's form."""

import json

from layouts import AXES, pinholes, poses, save_image

HAS_DEPTHS = False
HASH = "07d9f9724ca854fae07cb4c57d7ea22bf667d5decd4058f547728922f909956b"
LENS = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}


def write(views, folder):
    write_scene(views, folder / "1K" / HASH)
    return folder


def write_benchmark(views, folder):
    write_scene(views, folder / HASH / "nerfstudio")
    write_scene(views, folder / HASH / "nerfstudio", level=8)
    rows = f",hash,batch,indoor_outdoor\n0,{HASH},1K,indoor\n"
    (folder / "benchmark-meta.csv").write_text(rows)
    return folder


def write_scene(views, scene, level=4, lens=LENS):
    """The views are a quarter of the video's size, for which the intrinsics are."""
    frames = []
    for index, (image, pose) in enumerate(zip(views.images, poses(views), strict=True)):
        name = f"frame_{index + 1:05d}.png"
        save_image(scene / f"images_{level}" / name, image[:, :: level // 4, :: level // 4])
        matrix = (pose @ AXES).tolist()
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix})
    fx, fy, cx, cy = (4 * number for number in pinholes(views)[0])
    content = {
        **{"w": 4 * views.cameras.width, "h": 4 * views.cameras.height},
        **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "camera_model": "OPENCV", **lens},
        "applied_transform": [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]],
        "frames": frames,
    }
    (scene / "transforms.json").write_text(json.dumps(content, indent=4))
