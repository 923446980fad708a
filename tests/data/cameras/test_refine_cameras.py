"""Refined cameras are nearer to those that rendered the photographs than the given ones."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch

from asysplat.data import ProceduralScene, SceneOptions, open_scene
from asysplat.data.cameras import LEAST_FEATURES, CameraOptions, refine_cameras, refine_given
from asysplat.data.cameras.refine import LEAST_OF_LENS, LEAST_POINTS
from asysplat.data.photographs import open_photographs
from asysplat.data.write import write_transforms
from asysplat.scene import Views

COUNT, HEIGHT, WIDTH = 12, 240, 320
FOCAL_ERROR, SCALE = 1.05, 3.0
OFFSET = (1000.0, -2000.0, 50.0)


@pytest.fixture(scope="module")
def views():
    return ProceduralScene(1, HEIGHT, WIDTH, num_images=32).views(range(COUNT))


@pytest.fixture(scope="module")
def truth(views):
    """Exact poses, in the world of the files."""
    poses = views.cameras.cam_to_world.double().numpy()
    poses[:, :3, 3] *= SCALE
    return poses


@pytest.fixture(scope="module")
def folder(views, truth, tmp_path_factory):
    """Photographs with a focal length 5 % too long and disturbed poses."""
    random = np.random.default_rng(0)
    extent = np.ptp(truth[:, :3, 3], axis=0).max()
    poses = truth.copy()
    poses[:, :3, 3] += random.normal(0, 0.003 * extent, (COUNT, 3))
    cameras = views.cameras
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, (0, 1), (0, 1)] *= FOCAL_ERROR
    cameras = replace(cameras, intrinsics=intrinsics, cam_to_world=torch.tensor(poses).float())
    folder = tmp_path_factory.mktemp("scenes") / "walk"
    write_transforms(Views(cameras, views.images), folder)
    return folder


def read(folder):
    return open_scene(folder, SceneOptions(HEIGHT, WIDTH)).scene


@pytest.fixture(scope="module")
def refined(folder, tmp_path_factory):
    where = tmp_path_factory.mktemp("logs")
    return where, refine_cameras(read(folder), where)


def pose_errors(scene, truth):
    """Degrees between neighbors, and the distances of centers over the extent."""
    poses = np.array([image.cam_to_world for image in scene.images])
    relative = [np.swapaxes(p[:-1, :3, :3], 1, 2) @ p[1:, :3, :3] for p in (poses, truth)]
    cosines = (np.einsum("nij,nij->n", *relative) - 1) / 2
    moved = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    extent = np.ptp(truth[:, :3, 3], axis=0).max()
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean(), moved.mean() / extent


@pytest.mark.medium
def test_they_are_nearer_to_the_truth_and_in_the_given_world(views, folder, truth, refined):
    given, new = read(folder), refined[1].scene
    focal = views.cameras.intrinsics[0, 0, 0].item()
    assert given.images[0].lens.fx == pytest.approx(FOCAL_ERROR * focal, rel=1e-5)
    assert all(image.lens.fx == pytest.approx(focal, rel=0.01) for image in new.images)
    before, after = (pose_errors(scene, truth) for scene in (given, new))
    assert after[1] < before[1] and after[1] < 0.01
    assert refined[1].after < 0.7 * refined[1].before and refined[1].features > 1000
    assert refined[1].features > LEAST_FEATURES * refined[1].matched
    assert [image.file for image in new.images] == [image.file for image in given.images]
    # The points are surfaces of the true scene.
    depths = new.points @ np.linalg.inv(truth[0])[2, :3] + np.linalg.inv(truth[0])[2, 3]
    assert len(new.points) > 100 and np.median(depths) > 0


@pytest.mark.medium
def test_they_are_refined_once_and_nothing_is_written_beside(folder, refined, monkeypatch):
    monkeypatch.delattr(pycolmap, "extract_features")
    where, first = refined
    again = refine_cameras(read(folder), where)
    for one, other in zip(first.scene.images, again.scene.images, strict=True):
        assert np.array_equal(one.cam_to_world, other.cam_to_world) and one.lens == other.lens
    assert len(list(where.iterdir())) == 1
    assert sorted(path.name for path in folder.iterdir()) == ["images", "transforms.json"]


@pytest.mark.medium
def test_the_same_photographs_give_the_same_bits_also_around_another_origin(
    folder, refined, tmp_path
):
    again = refine_cameras(replace(read(folder), origin=OFFSET), tmp_path)
    assert (again.before, again.after) == (refined[1].before, refined[1].after)
    for one, other in zip(refined[1].scene.images, again.scene.images, strict=True):
        assert np.array_equal(one.cam_to_world, other.cam_to_world)
    assert again.scene.origin == OFFSET
    np.testing.assert_allclose(again.scene.points, refined[1].scene.points, atol=1e-9)


@pytest.mark.medium
def test_a_lens_of_few_photographs_stays(folder, tmp_path):
    scene = read(folder)
    few = replace(scene, images=scene.images[: LEAST_OF_LENS - 1])
    for given, new in zip(few.images, refine_cameras(few, tmp_path).scene.images, strict=True):
        assert new.lens.fx == pytest.approx(given.lens.fx, rel=1e-12)
        assert not any(new.lens.distortion) and (new.cam_to_world != given.cam_to_world).any()


def test_photographs_without_features_keep_their_cameras(views, tmp_path):
    black = Views(views.cameras, torch.zeros_like(views.images)).select(range(4))
    write_transforms(black, tmp_path / "black")
    scene, said = read(tmp_path / "black"), []
    assert refine_cameras(scene, tmp_path / "logs").features == 0
    kept, matched = refine_given(scene, CameraOptions("auto", tmp_path / "logs"), said.append)
    assert kept is scene and not matched and "too few features match" in said[0]


@pytest.mark.medium
def test_a_photograph_that_sees_few_points_keeps_its_pose(views, tmp_path):
    write_transforms(views, tmp_path / "scene")
    last = tmp_path / "scene" / "images" / f"{COUNT - 1:05d}.png"
    scene = read(tmp_path / "scene")
    noise = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    noisy = Views(views.cameras, noise.expand(COUNT, -1, -1, -1))
    write_transforms(noisy, tmp_path / "noise")
    last.write_bytes((tmp_path / "noise" / "images" / "00000.png").read_bytes())
    new = refine_cameras(scene, tmp_path / "logs").scene
    given, kept = (images[-1].cam_to_world for images in (scene.images, new.images))
    assert LEAST_POINTS > 0 and np.allclose(kept, given, atol=1e-12)


@pytest.mark.medium
def test_which_cameras_are_used(views, folder, tmp_path):
    def opened(choice, path=folder):
        said = []
        options = CameraOptions(choice, tmp_path / "logs")
        photographs = open_photographs(
            path, HEIGHT, held_out_every=6, cameras=options, say=said.append
        )
        return photographs.inputs.cameras.intrinsics[0, 0, 0].item(), said

    focal = views.cameras.intrinsics[0, 0, 0].item()
    assert opened("given")[0] == pytest.approx(FOCAL_ERROR * focal, rel=1e-5)
    for choice in ("auto", "refined", "found"):
        fx, said = opened(choice)
        assert fx == pytest.approx(focal, rel=0.02)
        assert said[0].startswith("cameras: found" if choice == "found" else "cameras: refined")
    exact = tmp_path / "exact"
    write_transforms(views, exact)
    fx, said = opened("auto", exact)
    assert fx == pytest.approx(focal, rel=1e-6) and said[0].startswith("cameras: as given")
    fx, said = opened("checked", exact)
    assert fx == pytest.approx(focal, rel=1e-6) and "they fit the points" in said[0]
    # Features are matched once, and again only if those that agree with the cameras are few.
    assert len(opened("auto", exact)[1]) == 1
    poses = views.cameras.cam_to_world * torch.tensor([1.0, -1, -1, 1])
    turned = Views(replace(views.cameras, cam_to_world=poses), views.images)
    write_transforms(turned, tmp_path / "turned")
    for choice in ("auto", "checked"):
        assert any("OpenGL axes" in each for each in opened(choice, tmp_path / "turned")[1])
