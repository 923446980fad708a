from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch

from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.data.procedural.geometry import Boxes, Cone, Spheres, Terrain
from asysplat.data.sequence import ImageSequence
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


def rays(count: int = 200) -> torch.Tensor:
    """Directions about the x axis."""
    return torch.stack((torch.ones(count), *(torch.rand(2, count) - 0.5)))


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


def test_procedural_scenes_are_image_sequences():
    short = ProceduralScene(3, 8, 8, num_images=10)
    assert isinstance(short, ImageSequence)
    assert (short.name, short.num_images, short.cameras.num_views) == ("procedural-3", 10, 10)
    views = short.views([7, 2]).validate()
    assert torch.equal(views.cameras.cam_to_world, short.cameras.cam_to_world[[7, 2]])


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


def test_rays_hit_boxes_on_the_surface():
    cos, sin = np.cos(0.4), np.sin(0.4)
    axes = torch.tensor([[[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]], dtype=torch.float32)
    boxes = Boxes(torch.tensor([[3.0, 0.2, -0.1]]), torch.tensor([[0.5, 0.8, 0.6]]), axes)
    directions = rays()
    t = boxes.hit(torch.zeros(3, 1), directions)[0]
    seen = t.isfinite()
    assert 20 < seen.sum() < 180
    points = (t * directions)[:, seen]
    local = axes[0] @ (points - boxes.centers.T) / boxes.halves.T
    torch.testing.assert_close(local.abs().amax(0), torch.ones(len(local[0])))
    face = boxes.facing(points, torch.zeros(points.shape[1], dtype=torch.long))
    assert torch.equal(face, local.abs().argmax(0))
    # Just before the hit a ray is outside, and a missing ray never comes inside.
    assert (boxes.distance(points * 0.999) > 0).all()
    along = directions[:, ~seen, None] * torch.linspace(0, 5, 400)
    assert boxes.distance(along.flatten(1)).min() > 0


def test_a_cone_contains_all_hit_spheres():
    torch.manual_seed(0)
    spheres = Spheres(4 * torch.randn(400, 3), 0.6 * torch.rand(400))
    directions = rays()
    origin = torch.zeros(3, 1)
    near = spheres.within(Cone.around(origin, directions))
    seen = spheres.hit(origin, directions).isfinite().any(1).nonzero()[:, 0]
    assert len(seen) > 20 and set(seen.tolist()) <= set(near.tolist())
    assert len(near) < 100
    # Rays from several points have no cone.
    everywhere = Cone.around(origin.expand(3, 200), directions)
    assert len(spheres.within(everywhere)) == 400


def test_rays_meet_the_terrain_on_its_surface():
    axis = torch.linspace(-10, 10, 21)
    x, y = torch.meshgrid(axis, axis, indexing="xy")
    heights = 0.2 * x + 0.3 * torch.sin(y)
    terrain = Terrain(torch.stack((heights, torch.full_like(x, 0.2), 0.3 * torch.cos(y))), 10.0)
    directions = rays()
    origin = torch.tensor([[-5.0], [0.0], [1.5]])
    t = terrain.hit(origin, directions, torch.full((200,), 14.0), 8)
    seen = t.isfinite()
    points = (origin + t * directions)[:, seen]
    assert 80 < seen.sum() < 180
    assert terrain.above(points[:, None]).abs().max() < 1e-3
    assert (directions[2, ~seen] > 0).all()
    torch.testing.assert_close(terrain.normals(points).norm(dim=0), torch.ones(int(seen.sum())))


def test_an_exact_guess_on_the_terrain_is_kept():
    terrain = Terrain(torch.zeros(3, 3, 3), 20.0)
    origin = torch.tensor([[-5.0], [0.0], [1.0]])
    directions = torch.tensor([[1.0, 0.0, -0.125], [1.0, 0.0, -0.25], [1.0, 0.0, 0.0]]).T
    t = terrain.hit(origin, directions, torch.full((3,), 14.0), 8)
    torch.testing.assert_close(t, torch.tensor([8.0, 4.0, torch.inf]))


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


def test_procedural_images_have_the_statistics_of_photographs():
    images = torch.stack([scene(seed).views([0, 30, 60]).images for seed in SEEDS])
    deviation = images.flatten(2).std(2).mean(1)
    assert 0.35 < images.mean() < 0.55
    assert (deviation > 0.15).all() and (deviation < 0.28).all()
    # Most energy is in low frequencies: half the resolution keeps most of the variance.
    halved = torch.nn.functional.avg_pool2d(images.flatten(0, 2), 2)
    assert halved.var() > 0.85 * images.var()


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
