import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from layouts import save_depth, save_image
from layouts.replica import write

from asysplat.data import SceneOptions, open_scene
from asysplat.errors import InputError

STEPS = 6553.5  # a meter, in the published files


@pytest.fixture
def room(views, tmp_path):
    return write(views.select(range(4)), tmp_path / "Réplica") / "room0"


def opened(room, height=24, width=32, **options):
    return open_scene(room, SceneOptions(height, width, layout="replica", **options))


def change_camera(room, **values):
    file = room.parent / "cam_params.json"
    camera = json.loads(file.read_text())["camera"] | values
    file.write_text(json.dumps({"camera": camera}))


def change_row(room, index, change):
    file = room / "traj.txt"
    rows = file.read_text().splitlines()
    rows[index] = change(rows[index])
    file.write_text("\n".join(rows))


def test_depths_have_the_published_steps(views, tmp_path):
    views = views.select(range(2))
    views = replace(views, depths=(views.depths * STEPS).round() / STEPS)
    sequence = opened(write(views, tmp_path, STEPS) / "room0")
    assert sequence.name == "room0"
    torch.testing.assert_close(sequence.views([0, 1]).depths, views.depths, rtol=0, atol=1e-5)


def test_the_principal_point_counts_from_the_corner(room):
    change_camera(room, cx=15.5, cy=11.5)
    assert opened(room).cameras.intrinsics[0, :2, 2].tolist() == [16, 12]


def test_a_room_on_its_own_has_the_parameters_in_it(room):
    (room.parent / "cam_params.json").rename(room / "cam_params.json")
    assert opened(room).num_images == 4


def test_without_depth_maps_there_are_no_depths(room):
    for file in room.glob("results/depth*"):
        file.unlink()
    assert opened(room).views([0]).depths is None


def test_depths_may_be_smaller(room):
    for index in range(4):
        save_depth(room / f"results/depth{index:06d}.png", torch.full((12, 16), 2.0))
    assert opened(room).views([0]).depths.unique().tolist() == [2]


FRAMES = {
    "missing": (lambda room: (room / "results/frame000002.jpg").unlink(), "002.jpg does not exist"),
    "cut short": (
        lambda room: (room / "results/frame000002.jpg").write_bytes(b"\x89PNG\r\n\x1a\n"),
        "002.jpg cannot be read",
    ),
    "missing depth": (
        lambda room: (room / "results/depth000002.png").unlink(),
        "depth000002.png does not exist",
    ),
    "depth of other proportions": (
        lambda room: save_depth(room / "results/depth000002.png", torch.ones(24, 24)),
        "depth000002.png is 24 x 24 and the image 32 x 24",
    ),
    "size": (
        lambda room: save_image(room / "results/frame000002.jpg", torch.ones(3, 12, 16)),
        r"002.jpg is 16 x 12, but .*cam_params.json says 32 x 24",
    ),
    "nan": (
        lambda room: change_row(room, 2, lambda row: row.replace(row.split()[3], "nan")),
        "traj.txt, row 3 holds NaN",
    ),
    "15 numbers": (
        lambda room: change_row(room, 2, lambda row: row.rsplit(maxsplit=1)[0]),
        "traj.txt, row 3 is not 4x4",
    ),
    "no number": (
        lambda room: change_row(room, 2, lambda row: row + "x"),
        "traj.txt, row 3 is not 4x4",
    ),
    "world-to-camera": (
        lambda room: change_row(
            room, 2, lambda row: " ".join(np.array(row.split()).reshape(4, 4).T.ravel())
        ),
        "traj.txt, row 3 has last row",
    ),
}


@pytest.mark.parametrize("damage, message", FRAMES.values(), ids=FRAMES.keys())
def test_a_bad_frame_is_named_or_left_out(room, damage, message):
    damage(room)
    with pytest.raises(InputError, match=f"1 of 4 images cannot be used(.|\n)*{message}"):
        opened(room)
    with pytest.warns(UserWarning, match=f"left out 1 of 4 images(.|\n)*{message}"):
        assert opened(room, on_bad_image="skip").num_images == 3


def test_all_bad_frames_are_told_together(room):
    for damage, _ in (FRAMES["missing"], FRAMES["nan"]):
        damage(room)
    change_row(room, 0, lambda row: "1 2 3")
    with pytest.raises(InputError, match=r"2 of 4 images(.|\n)*row 1 is not(.|\n)*002.jpg does"):
        opened(room)


SCENES = {
    "more frames than rows": (
        lambda room: change_row(room, 3, lambda row: ""),
        "traj.txt has 3 rows for 4 frames",
    ),
    "no trajectory": (lambda room: (room / "traj.txt").unlink(), "traj.txt does not exist"),
    "no parameters": (
        lambda room: (room.parent / "cam_params.json").unlink(),
        "cam_params.json does not exist",
    ),
    "no camera": (
        lambda room: (room.parent / "cam_params.json").write_text("[]"),
        'cam_params.json has no "camera"',
    ),
    "no focal length": (lambda room: change_camera(room, fx=None), "fx is None"),
    "no scale": (lambda room: change_camera(room, scale=0), "must be above 0"),
    "infinite": (lambda room: change_camera(room, cx=float("inf")), "cx is inf"),
}


@pytest.mark.parametrize("damage, message", SCENES.values(), ids=SCENES.keys())
def test_a_broken_scene_is_refused(room, damage, message):
    damage(room)
    with pytest.raises(InputError, match=message):
        opened(room, on_bad_image="skip")
