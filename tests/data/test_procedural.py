from functools import cache
from itertools import pairwise

import pytest
import torch

from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.errors import InputError

pytestmark = pytest.mark.usefixtures("one_thread")
SEEDS = range(4)
# Mean red, green, blue and inverse depth of two images of validation and test scenes.
EVALUATION_SCENES = {
    ("val", 0): (0.4633, 0.4809, 0.4476, 0.2796),
    ("val", 3): (0.4622, 0.4736, 0.4734, 0.1597),
    ("test", 0): (0.5631, 0.4541, 0.3573, 0.2878),
    ("test", 1): (0.4801, 0.4875, 0.4184, 0.2234),
    ("test", 4): (0.4972, 0.5051, 0.4965, 0.1711),
    ("test", 7): (0.4903, 0.5143, 0.4261, 0.1988),
}


@cache
def scene(seed: int, varied: bool = False) -> ProceduralScene:
    return ProceduralScene(seed, 48, 48, varied=varied)


@pytest.mark.parametrize("varied", [False, True])
def test_a_seed_gives_the_same_bits_of_a_scene(varied):
    first, second = (ProceduralScene(5, 16, 24, varied=varied).views([0, 95, 3]) for _ in range(2))
    assert torch.equal(first.images, second.images)
    assert torch.equal(first.depths, second.depths)
    assert torch.equal(first.cameras.cam_to_world, second.cameras.cam_to_world)
    assert not torch.equal(first.images, ProceduralScene(6, 16, 24).views([0, 95, 3]).images)


@pytest.mark.parametrize(("split", "index"), EVALUATION_SCENES)
def test_validation_and_test_scenes_never_change(split, index):
    views = ProceduralScene(split_seed(split, index), 16, 16).views([0, 48])
    found = [*views.images.mean((0, 2, 3)), (1 / views.depths).mean()]
    # Bits depend on the processor; one pixel of another object makes 1e-3 at most.
    assert found == pytest.approx(EVALUATION_SCENES[split, index], abs=1e-3)


@pytest.mark.medium
def test_half_of_the_seeds_are_rooms_and_places_override_the_seed():
    # Nothing in a room is farther than its diagonal; the sky is 60 m away.
    farthest = [ProceduralScene(seed, 8, 8).views([0, 48]).depths.max() for seed in range(16)]
    assert 4 <= sum(depth < 12 for depth in farthest) <= 12
    for seed in range(2):
        drawn, room, outdoors = (
            ProceduralScene(seed, 16, 16, places=places).views([0, 48])
            for places in ("both", "rooms", "outdoors")
        )
        assert room.depths.max() < 12 < outdoors.depths.max()
        same, other = (room, outdoors) if drawn.depths.max() < 12 else (outdoors, room)
        assert torch.equal(drawn.images, same.images) and torch.equal(drawn.depths, same.depths)
        assert not torch.equal(drawn.images, other.images)
    with pytest.raises(InputError, match=r"data\.places is 'caves'.*both, rooms, outdoors"):
        ProceduralScene(0, 8, 8, places="caves")


def test_seeds_of_splits_are_disjoint():
    seeds = [{split_seed(split, index) for index in range(300)} for split in ("train", "val")]
    seeds.append({split_seed("test", index) for index in range(300)})
    assert len(set.union(*seeds)) == 900
    assert split_seed("train", 10**12) == 3 * 10**12
    with pytest.raises(InputError, match="numbered from 0"):
        split_seed("train", -1)


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_neighboring_images_reproject(seed, varied):
    views = scene(seed, varied).views([40, 43])
    agree, error = reprojection(views)
    assert agree > (0.75 if varied else 0.85)  # thin and near things hide more
    assert error < 0.04


def reprojection(views) -> tuple[float, float]:
    """Of the first view's pixels that the second could see: agreeing share, mean color error."""
    size = views.cameras.height
    y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    pixels = torch.stack((x, y, torch.ones_like(x))).flatten(1)
    unproject = views.cameras.intrinsics[0].inverse() @ pixels * views.depths[0].flatten()
    first, second = views.cameras.cam_to_world
    world = first[:3, :3] @ unproject + first[:3, 3:]
    camera = second[:3, :3].T @ (world - second[:3, 3:])
    projected = views.cameras.intrinsics[1] @ camera
    place = projected[:2] / projected[2] * (2 / size) - 1
    inside = (place.abs() < 1 - 1 / size).all(0) & (camera[2] > 0)
    both = torch.cat((views.images[1], views.depths[1][None]))[None]
    grid = place.T[None, None]
    seen = torch.nn.functional.grid_sample(both, grid, align_corners=False)[0, :, 0]
    same = (seen[3] / camera[2] - 1).abs() < 0.02
    error = (seen[:3] - views.images[0].flatten(1)).abs().mean(0)
    return same[inside].float().mean().item(), error[inside & same].mean().item()


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_move_smoothly_and_keep_clear(seed, varied):
    cameras = scene(seed, varied).cameras
    poses = cameras.cam_to_world
    steps = [(after - before)[:3, 3].norm() for before, after in pairwise(poses)]
    least, most = (0.002, 0.25) if varied else (0.005, 0.15)
    assert least < max(steps) < most
    cosines = ((poses[1:, :3, :3] * poses[:-1, :3, :3]).sum((1, 2)) - 1) / 2
    assert torch.rad2deg(cosines.clamp(max=1).arccos()).max() < (6 if varied else 4)
    if not varied:
        assert 1.5 < torch.cdist(cameras.centers, cameras.centers).max() < 5.5
    views = scene(seed, varied).views(range(0, 96, 6)).validate()
    assert views.depths.min() > 0.3
