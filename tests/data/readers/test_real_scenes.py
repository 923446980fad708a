"""Real scenes, whose own files agree with their COLMAP model."""

import numpy as np
import pytest
import torch

from asysplat.data import SceneOptions, open_scene
from asysplat.data.bad_images import BadImages
from asysplat.data.readers import colmap, llff, long_lrm, posed, transforms

SCENES = {"fern": llff, "fox": transforms, "mydesk": long_lrm, "hololens-000": posed}


@pytest.fixture(params=SCENES)
def scene(request, shared):
    folder = shared / "data" / request.param
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    return folder


def read(layout, folder):
    bad = BadImages()
    scenes = layout.find_scenes(folder)
    scene = layout.read_scene(scenes[0], bad)
    assert len(scenes) == 1 and not bad.errors
    return scene


@pytest.mark.medium
def test_a_layouts_reader_and_colmaps_give_the_same_cameras(scene):
    own, model = (
        {image.file: image for image in read(layout, scene).images}
        for layout in (SCENES[scene.name], colmap)
    )
    assert own.keys() == model.keys()
    poses, others = (
        np.array([images[file].cam_to_world for file in own]) for images in (own, model)
    )
    size = np.ptp(poses[:, :3, 3], axis=0).max()
    assert np.abs(poses - others)[:, :3, :3].max() < 1e-5
    assert np.abs(poses - others)[:, :3, 3].max() < 1e-5 * size

    def intrinsics(images):
        lenses = [images[file].lens for file in own]
        assert not any(lens.is_distorted for lens in lenses)
        return np.array([(p.width, p.height, p.fx, p.fy, p.cx, p.cy) for p in lenses])

    np.testing.assert_allclose(intrinsics(own), intrinsics(model), rtol=1e-5)


@pytest.mark.medium
def test_points_of_real_scenes_are_in_their_images(scene):
    sequence = open_scene(scene, SceneOptions(64, 64))
    views = sequence.views(range(0, sequence.num_images, 10)).validate()
    assert views.images.std() > 0.05
    assert (views.depths is not None) == (scene.name == "hololens-000")
    points = torch.as_tensor(sequence.points).to(views.cameras.centers)
    pixels, depth, inside = views.cameras.project(points)
    assert inside.sum(1).float().median() > 200
    if views.depths is not None:
        x, y = pixels.clamp(0, 63).long().unbind(-1)
        seen = views.depths.flatten(1).gather(1, y * 64 + x)
        ratio = (depth / seen)[inside & (seen > 0)].log()
        assert ratio.abs().median() < 0.1  # some points are occluded
