from dataclasses import replace

import numpy as np
import pytest
import torch
from layouts import assert_listed, assert_same, edit_json, opener, save_image, table
from layouts.replica import write

from asysplat.errors import InputError

STEPS = 6553.5  # a meter, in the published files
opened = opener("replica")


@pytest.fixture
def room(few, tmp_path):
    return write(few, tmp_path / "Réplica") / "room0"


def parameters(room):
    return room.parent / "cam_params.json"


def set_camera(**values):
    return lambda room: edit_json(
        parameters(room), lambda content: content["camera"].update(values)
    )


def set_row(index, change):
    def damage(room):
        rows = (room / "traj.txt").read_text().splitlines()
        rows[index] = change(rows[index])
        (room / "traj.txt").write_text("\n".join(rows))

    return damage


def test_depths_have_the_published_steps(views, tmp_path):
    views = views.select(range(2))
    views = replace(views, depths=(views.depths * STEPS).round() / STEPS)
    sequence = opened(write(views, tmp_path, STEPS) / "room0")
    assert sequence.name == "room0"
    assert_same(sequence.views([0, 1]).depths, views.depths)


def test_a_room_alone_without_depth_maps(room):
    set_camera(cx=15.5, cy=11.5)(room)
    parameters(room).rename(room / "cam_params.json")
    for file in room.glob("results/depth*"):
        file.unlink()
    views = opened(room).views(range(4))
    assert views.depths is None
    # The principal point counts from the corner.
    assert views.cameras.intrinsics[0, :2, 2].tolist() == [16, 12]


def transposed(row):
    return " ".join(np.array(row.split()).reshape(4, 4).T.ravel())


@table(
    {
        "size": (
            lambda room: save_image(room / "results/frame000002.jpg", torch.ones(3, 12, 16)),
            "cam_params.json is for 32 x 24",
        ),
        "world-to-camera": (set_row(2, transposed), "traj.txt, row 3 has last row"),
    }
)
def test_a_bad_image_is_named_or_left_out(room, damage, message):
    damage(room)
    assert_listed(opened, room, message)


def test_more_images_than_poses_are_refused(room):
    set_row(3, lambda row: "")(room)
    with pytest.raises(InputError, match=r"traj.txt has 3 rows for 4 images"):
        opened(room, on_error="skip")
