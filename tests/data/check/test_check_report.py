"""Diagnosis of real scenes, with their own cameras and with known mistakes in them."""

import re
from dataclasses import replace

import pytest
import torch

from asysplat.data.bad_images import BadImages
from asysplat.data.check.matches import find_matches
from asysplat.data.check.report import MAX_ERROR, diagnose_cameras, measure_fit
from asysplat.data.readers import llff, long_lrm, posed, transforms
from asysplat.data.sequence import FileSequence, SceneOptions

LAYOUTS = {"fern": llff, "fox": transforms, "mydesk": long_lrm, "hololens-000": posed}
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in ("fox", "mydesk", "hololens-000")]


@pytest.fixture(scope="module", params=["fern", *OTHERS])
def real(request, shared):
    """Cameras, matches and image names of a real scene."""
    folder = shared / "data" / request.param
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    scene = LAYOUTS[request.param].read_scene(folder, BadImages())
    lens = scene.images[0].lens
    sequence = FileSequence(scene, SceneOptions(lens.height, lens.width))
    names = [str(photograph.file) for photograph in scene.images]
    return sequence.cameras.to(torch.float64), find_matches(sequence), names


def posed_by(change):
    return lambda cameras: replace(cameras, cam_to_world=change(cameras.cam_to_world))


def axes(*columns):
    """Cameras whose axes are read in another order: each column is the (signed) 1, 2 or 3 of right,
    down and forward."""
    turn = torch.zeros(4, 4, dtype=torch.float64)
    turn[3, 3] = 1
    for place, column in enumerate(columns):
        turn[abs(column) - 1, place] = 1 if column > 0 else -1
    return posed_by(lambda poses: poses @ turn)


def scaled(*factors):
    return lambda cameras: replace(
        cameras, intrinsics=cameras.intrinsics * torch.tensor([*factors, 1]).double()[:, None]
    )


def parts(rotations, positions):
    """Cameras with rotations from one kind of matrices, and positions from another."""

    def change(poses):
        given, poses = poses, poses.clone()
        poses[:, :3, :3], poses[:, :3, 3] = rotations(given), positions(given)
        return poses

    return posed_by(change)


def rotation(poses):
    return poses[:, :3, :3]


inverse, W2C = torch.linalg.inv, "world-to-camera matrices were taken for camera-to-world"
SWAP = torch.eye(4).double()[[0, 2, 1, 3]]
# A broken copy of the cameras, and words of its diagnosis; the first are far off.
SEVERE = [
    (axes(1, -2, -3), "OpenGL axes were taken for OpenCV's"),
    (posed_by(inverse), f"{W2C} ("),
    (posed_by(lambda poses: FLIP @ inverse(poses)), f"{W2C}, and OpenGL"),
    (scaled(2, 2), "images 2 times the size"),
    (scaled(0.5, 0.5), "images 1/2 the size"),
    (scaled(0.25, 0.25), "images 1/4 the size"),
    (axes(2, 1, -3), "LLFF axes were taken for OpenCV's"),
    (axes(1, 3, -2), "axes y and z are exchanged"),
    (axes(2, -1, 3), "axes x and y are exchanged"),
]
SLIGHT = [
    (parts(lambda p: rotation(p).mT, lambda p: p[:, :3, 3]), "rotations are transposed"),
    (
        parts(rotation, lambda p: inverse(p)[:, :3, 3]),
        "translations of world-to-camera were taken for positions",
    ),
    (parts(rotation, lambda p: -p[:, :3, 3]), "positions are negated"),
    (posed_by(lambda p: p.roll(1, 0)), "every pose belongs to the image 1 place earlier"),
    (posed_by(lambda p: p.flip(0)), "the poses run backwards"),
    (posed_by(lambda p: SWAP @ p @ SWAP), "axes y and z are exchanged"),  # and the world's
]


def test_cameras_as_published_fit(real):
    verdict = diagnose_cameras(*real)
    assert verdict.fits and verdict.summary == "the cameras fit the images"
    assert verdict.fit.error < 0.6 < MAX_ERROR
    assert verdict.fit.under_1px > 0.8 and verdict.fit.behind_camera < 0.01
    assert len(real[1].pairs) >= 8


@pytest.mark.medium
@pytest.mark.parametrize("mistakes", [SEVERE, SLIGHT], ids=["severe", "slight"])
def test_mistakes_of_cameras_are_named(real, mistakes):
    cameras, matches, names = real
    for broken, name in mistakes:
        verdict = diagnose_cameras(broken(cameras), matches, names)
        assert not verdict.fits and name in verdict.summary, name
        if mistakes is SEVERE:
            assert verdict.fit.error > 5, name
            assert "(corrected, the error is" in verdict.summary, name


@pytest.mark.medium
def test_other_resolutions_are_fitted(real):
    cameras, matches, names = real
    verdict = diagnose_cameras(scaled(1.4, 1.4)(cameras), matches, names)
    factor = re.search(r"those of images (.+) times the size", verdict.summary)[1]
    assert not verdict.fits and float(factor) == pytest.approx(1.4, rel=0.01)


def test_the_fit_of_cameras_does_not_depend_on_the_world_frame(real):
    cameras, matches, _ = real
    world = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 2], [1, 0, 0.5], [-2, -0.5, 0]]))
    moved = cameras.cam_to_world.clone()
    moved[:, :3] = world.double() @ moved[:, :3]
    moved[:, :3, 3] = 7 * moved[:, :3, 3] + 3
    moved = replace(cameras, cam_to_world=moved)
    assert measure_fit(moved, matches).error == pytest.approx(
        measure_fit(cameras, matches).error, rel=1e-3
    )


@pytest.mark.medium
def test_shuffled_poses_match_no_mistake(real):
    cameras, matches, names = real
    order = torch.randperm(cameras.num_views)
    shuffled = replace(cameras, cam_to_world=cameras.cam_to_world[order])
    verdict = diagnose_cameras(shuffled, matches, names)
    assert not verdict.fits and "no usual mistake explains it" in verdict.summary


@pytest.mark.medium
def test_poses_sorted_as_strings_are_named(real):
    cameras, matches, names = real
    # As if the files had no leading zeros.
    names = [f"images/{frame}.jpg" for frame in range(len(names))]
    order = torch.tensor(sorted(range(len(names)), key=lambda frame: names[frame]))
    verdict = diagnose_cameras(
        replace(cameras, cam_to_world=cameras.cam_to_world[order]), matches, names
    )
    assert "sorted by their numbers, the poses as strings" in verdict.summary
