"""Writers of the layouts on disk, one module each, and helpers of their tests.

write(views, folder) -> what a user would give as data.root

A module has HAS_DEPTHS = False, or FREE_INTRINSICS = False (one focal length, and the principal
point at the center), if its layout cannot hold more.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.data import SceneOptions, open_scene
from asysplat.errors import InputError

MILLIMETERS = 1000  # a scene unit
AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's from OpenCV's


def save_image(path: Path, image: torch.Tensor) -> None:
    """Write [3, H, W] in [0, 1] as PNG, whatever the name's suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = (image * 255).round().byte().permute(1, 2, 0)
    Image.fromarray(levels.numpy()).save(path, format="png")


def save_depth(path: Path, depth: torch.Tensor, steps: float = MILLIMETERS) -> None:
    """Write [H, W] as 16-bit PNG of `steps` per scene unit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = (depth.double() * steps).round().numpy().astype(np.uint16)
    Image.fromarray(stored).save(path)


def pinholes(views) -> list[tuple[float, float, float, float]]:
    """fx, fy, cx, cy of every view."""
    return [(k[0][0], k[1][1], k[0][2], k[1][2]) for k in views.cameras.intrinsics.tolist()]


def poses(views) -> np.ndarray:
    """Camera-to-world, [V, 4, 4] float64."""
    return views.cameras.cam_to_world.double().numpy()


def opener(layout):
    """A function that opens a scene of this layout at 24 x 32."""

    def opened(path, **options):
        return open_scene(path, SceneOptions(24, 32, layout, **options))

    return opened


def edit_json(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def cut(file, left=200):
    file.write_bytes(file.read_bytes()[:left])


def assert_same(found, expected):
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def assert_listed(opened, path, *messages, total=4):
    """All bad images are listed in one error, in order, or left out with a warning."""
    bad = len(messages)
    with pytest.raises(InputError) as error:
        opened(path)
    summary, *sentences = str(error.value).splitlines()
    assert f"{bad} of {total} images cannot be used" in summary
    for sentence, message in zip(sentences, messages, strict=True):
        assert message in sentence
    with pytest.warns(UserWarning) as warnings:
        sequence = opened(path, on_error="skip")
    (warning,) = (str(each.message) for each in warnings)
    assert f"left out {bad} of {total} images" in warning
    assert all(message in warning for message in messages)
    assert sequence.num_images == total - bad
    return sequence


def table(cases):
    """Parametrize a test by name -> (damage, message)."""
    return pytest.mark.parametrize("damage, message", cases.values(), ids=cases.keys())
