"""Real scenes, whose own files and whose COLMAP model say the same."""

import numpy as np
import pytest

from asysplat.data import SceneOptions, open_scene
from asysplat.data.bad_images import BadImages
from asysplat.data.points import depths_of_points
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


def test_both_readers_give_the_same_cameras(scene):
    own = {
        photograph.file: photograph for photograph in read(SCENES[scene.name], scene).images
    }
    model = {photograph.file: photograph for photograph in read(colmap, scene).images}
    common = sorted(own.keys() & model.keys())
    assert len(common) == len(own) == len(model)
    poses = np.array([own[image].cam_to_world for image in common])
    others = np.array([model[image].cam_to_world for image in common])
    size = np.ptp(poses[:, :3, 3], axis=0).max()
    assert np.abs(poses - others)[:, :3, :3].max() < 1e-5
    assert np.abs(poses - others)[:, :3, 3].max() < 1e-5 * size

    def intrinsics(photographs):
        lenses = [photographs[image].lens for image in common]
        assert not any(lens.is_distorted for lens in lenses)
        return np.array([(p.width, p.height, p.fx, p.fy, p.cx, p.cy) for p in lenses])

    np.testing.assert_allclose(intrinsics(own), intrinsics(model), rtol=1e-5)


def test_it_opens_in_its_own_layout(scene):
    sequence = open_scene(scene, SceneOptions(64, 64))
    views = sequence.views([0, sequence.num_images // 2, sequence.num_images - 1]).validate()
    assert views.images.std() > 0.05
    assert (views.depths is not None) == (scene.name == "hololens-000")


def test_points_seen_lie_on_the_surfaces(scene):
    sequence = open_scene(scene, SceneOptions(64, 64))
    views = sequence.views(range(0, sequence.num_images, 10))
    depths = depths_of_points(sequence.points, views.cameras)
    assert (depths > 0).sum((1, 2)).median() > 200
    if views.depths is not None:
        known = (depths > 0) & (views.depths > 0)
        ratio = (depths[known] / views.depths[known]).log()
        assert ratio.abs().median() < 0.03
        assert (ratio > 0.1).float().mean() < 0.05  # hidden points are left out


def test_points_lie_before_the_cameras_that_see_them(scene):
    found = read(colmap, scene)
    in_front = []
    for photograph in found.images:
        world_to_cam = np.linalg.inv(photograph.cam_to_world)
        x, y, z = world_to_cam[:3, :3] @ found.points.T + world_to_cam[:3, 3:]
        lens = photograph.lens
        u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        in_front.append(
            ((z > 0) & (abs(u - lens.cx) < lens.cx) & (abs(v - lens.cy) < lens.cy)).sum()
        )
    assert min(in_front) > 20
