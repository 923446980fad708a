import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.data.procedural import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.scene import Views


@pytest.fixture(scope="module")
def views() -> Views:
    """With a focal length of its own for each image."""
    views = ProceduralScene(2, 12, 16).views([0, 40, 80])
    views.cameras.intrinsics[:, 0, 0] += torch.arange(3)
    return views


def test_written_transforms_follow_the_format(views, tmp_path):
    write_transforms(views, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (content["w"], content["h"]) == (16, 12)
    for entry, matrix in zip(content["frames"], views.cameras.intrinsics, strict=True):
        fx, fy, cx, cy = (entry[name] for name in ("fl_x", "fl_y", "cx", "cy"))
        assert [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] == matrix.tolist()
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


def test_depths_beyond_16_bits_are_unknown(views, tmp_path):
    far = Views(views.cameras, views.images, views.depths + 65.5)
    write_transforms(far, tmp_path)
    write_transforms(replace(views, depths=None), tmp_path / "plain")
    assert not (tmp_path / "plain" / "depth").exists()
    assert np.asarray(Image.open(tmp_path / "depth" / "00000.png")).max() == 0


def test_write_transforms_overwrites_nothing_and_refuses_batches(views, tmp_path):
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match=r"transforms\.json exists"):
        write_transforms(views, tmp_path)
    with pytest.raises(InputError, match="one by one"):
        write_transforms(Views.stack([views, views]), tmp_path / "batch")
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]
