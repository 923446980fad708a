import json

import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.data import SceneOptions, open_scene
from asysplat.data.procedural import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views


@pytest.fixture(scope="module")
def views() -> Views:
    return ProceduralScene(2, 12, 16).views([0, 40, 80])


def test_files_follow_the_format(views, tmp_path):
    write_transforms(views, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (content["w"], content["h"]) == (16, 12)
    intrinsics = torch.eye(3)
    intrinsics[0, 0], intrinsics[1, 1] = content["fl_x"], content["fl_y"]
    intrinsics[0, 2], intrinsics[1, 2] = content["cx"], content["cy"]
    assert torch.equal(intrinsics.expand(3, 3, 3), views.cameras.intrinsics)
    opengl = torch.tensor([frame["transform_matrix"] for frame in content["frames"]])
    assert torch.equal(opengl[:, :, (0, 3)], views.cameras.cam_to_world[:, :, (0, 3)])
    assert torch.equal(opengl[:, :, 1:3], -views.cameras.cam_to_world[:, :, 1:3])

    frame = content["frames"][1]
    image = np.asarray(Image.open(tmp_path / frame["file_path"])) / 255
    assert np.abs(image - views.images[1].permute(1, 2, 0).numpy()).max() <= 0.5 / 255 + 1e-6
    steps = np.asarray(Image.open(tmp_path / frame["depth_file_path"]))
    assert steps.dtype == np.uint16
    depth = steps * content["depth_unit_scale_factor"]
    assert np.abs(depth - views.depths[1].numpy()).max() <= 0.5e-3 + 1e-5


def test_the_reader_round_trips(views, tmp_path):
    write_transforms(views, tmp_path)
    read = open_scene(tmp_path, SceneOptions(12, 16)).views([0, 1, 2])
    torch.testing.assert_close(read.cameras.cam_to_world, views.cameras.cam_to_world)
    torch.testing.assert_close(read.cameras.intrinsics, views.cameras.intrinsics)
    torch.testing.assert_close(read.images, views.images, atol=0.51 / 255, rtol=0)
    torch.testing.assert_close(read.depths, views.depths, atol=0.51e-3, rtol=0)


def test_different_intrinsics_are_written_per_frame(views, tmp_path):
    intrinsics = views.cameras.intrinsics.clone()
    intrinsics[1, 0, 0] += 1
    cameras = Cameras(intrinsics, views.cameras.cam_to_world, 12, 16)
    write_transforms(Views(cameras, views.images), tmp_path / "new")
    content = json.loads((tmp_path / "new" / "transforms.json").read_text())
    assert [frame["fl_x"] for frame in content["frames"]] == intrinsics[:, 0, 0].tolist()
    assert "fl_x" not in content and "fl_y" in content
    assert not (tmp_path / "new" / "depth").exists()


def test_depths_beyond_16_bits_are_unknown(views, tmp_path):
    far = Views(views.cameras, views.images, views.depths + 65.5)
    write_transforms(far, tmp_path)
    assert np.asarray(Image.open(tmp_path / "depth" / "00000.png")).max() == 0


def test_nothing_is_overwritten(views, tmp_path):
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match=r"transforms\.json exists"):
        write_transforms(views, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]


def test_batches_are_refused(views, tmp_path):
    with pytest.raises(InputError, match="one by one"):
        write_transforms(Views.stack([views, views]), tmp_path)
