import shutil

import numpy as np
import pytest
from layouts import colmap as colmap_layout
from layouts import llff as layout
from layouts import opener

from asysplat.errors import InputError

open_llff = opener("llff")


@pytest.fixture
def scene(centered_views, tmp_path):
    return layout.write(centered_views, tmp_path)


def test_the_largest_complete_folder_is_read(scene):
    shutil.copytree(scene / "images_8", scene / "images")
    shutil.copytree(scene / "images_8", scene / "images_4")
    (scene / "images/.DS_Store").write_text("")
    assert open_llff(scene).scene.images[0].file.parent.name == "images"
    (scene / "images/image003.png").unlink()
    assert open_llff(scene).scene.images[0].file.parent.name == "images_4"


def test_images_and_rows_that_differ_in_number_are_refused(scene):
    (scene / "images_8/image003.png").unlink()
    with pytest.raises(InputError, match=r"npy has 12 rows, but .* 11 in images_8/"):
        open_llff(scene)
    shutil.rmtree(scene / "images_8")
    with pytest.raises(InputError, match="the images there are none"):
        open_llff(scene)


def test_points_of_a_model_beside_the_images_are_read(scene, centered_views, tmp_path):
    model = colmap_layout.write(centered_views, tmp_path / "model")
    for index in range(12):
        (scene / f"images_8/image{index:03d}.png").rename(scene / f"images_8/{index:02d}.png")
    text = model / "sparse/0/images.txt"
    text.write_text(text.read_text().replace(" 0.png", " 00.png"))
    assert open_llff(scene).scene.points is None
    shutil.copytree(model / "sparse", scene / "sparse")
    np.testing.assert_allclose(
        open_llff(scene).scene.points, colmap_layout.points_of(centered_views), atol=1e-9
    )
