import json

import numpy as np
import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.data.selection import (
    Selection,
    every_8th_selection,
    first_96_selection,
    held_out,
    kmeans_selection,
    named_selection,
    nearest_to_centers,
    pose_features,
    training_images,
    training_selection,
    uniform_selection,
)
from asysplat.data.selection.__main__ import main as index_command
from asysplat.data.selection.index import Entry, read_index, select_from_index, write_index
from asysplat.errors import InputError
from asysplat.scene import Cameras


def cameras_at(centers, forwards=None) -> Cameras:
    """Cameras that look along `forwards`, all along z where it is left out."""
    centers = torch.as_tensor(centers, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(centers), 1, 1)
    poses[:, :3, 3] = centers
    if forwards is not None:
        z = torch.nn.functional.normalize(torch.as_tensor(forwards, dtype=torch.float64), dim=-1)
        x = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).double().expand_as(z), z)
        x = torch.nn.functional.normalize(x, dim=-1)
        poses[:, :3, :3] = torch.stack((x, torch.linalg.cross(z, x), z), -1)
    return Cameras(torch.eye(3, dtype=torch.float64).repeat(len(centers), 1, 1), poses, 4, 4)


def test_uniform_inputs_are_even_and_targets_midway():
    assert uniform_selection(17, 5, 4) == Selection([0, 4, 8, 12, 16], [2, 6, 10, 14])
    assert uniform_selection(81, 9, 2).targets == [25, 65]  # spread over the gaps
    assert uniform_selection(7, 4, 3) == Selection([0, 2, 4, 6], [1, 3, 5])  # every image
    for num_images in range(8, 60):
        selected = uniform_selection(num_images, num_inputs=3, num_targets=5)
        chosen = selected.inputs + selected.targets
        assert len(set(chosen)) == 8, num_images
        assert min(chosen) >= 0 and max(chosen) < num_images, num_images
        assert selected.targets == sorted(selected.targets), num_images


def test_training_stays_in_its_window_shares_no_image_and_is_repeated_by_its_seed():
    rng, again = np.random.default_rng(0), np.random.default_rng(0)
    starts = set()
    for _ in range(200):
        selected = training_selection(50, num_inputs=4, num_targets=3, window=(10, 20), rng=rng)
        assert selected == training_selection(50, 4, 3, (10, 20), again)
        ordered = selected.inputs
        assert len(set(selected.inputs + selected.targets)) == 7
        assert 10 <= ordered[-1] - ordered[0] + 1 <= 20
        assert ordered[0] < min(selected.targets) and max(selected.targets) < ordered[-1]
        assert np.ptp(np.diff(ordered)) <= 1
        assert selected.targets == sorted(selected.targets)
        starts.add(ordered[0])
    assert min(starts) <= 1 and max(starts) >= 36 and len(starts) > 30
    assert training_selection(9, 4, 3, (64, 128), rng).inputs == [0, 3, 5, 8]  # is clipped
    assert training_selection(9, 4, 3, None, rng).inputs == [0, 3, 5, 8]  # the whole sequence


def test_too_short_a_sequence_or_window_is_refused():
    with pytest.raises(InputError, match=r"has 6 images.*data\.inputs and data\.targets.*6"):
        uniform_selection(6, num_inputs=4, num_targets=3)
    with pytest.raises(InputError, match=r"data\.window"):
        training_selection(50, 4, 3, (6, 20), np.random.default_rng(0))


def test_targets_of_training_may_be_inputs_where_allowed():
    rng = np.random.default_rng(0)
    shared = []
    for _ in range(100):
        selected = training_selection(50, 4, 3, (8, 8), rng, targets_may_be_inputs=True)
        assert len(set(selected.targets)) == 3 and min(selected.inputs) <= min(selected.targets)
        shared.append(len(set(selected.inputs) & set(selected.targets)))
    # 3 of 8 images; 4 of the 8 are inputs.
    assert 1.2 < np.mean(shared) < 1.8


def test_held_out_and_training_images_share_none():
    sets = [set(held_out(50, "test")), set(held_out(50, "val")), set(training_images(50))]
    assert set.union(*sets) == set(range(50))
    assert sum(map(len, sets)) == 50
    selected = every_8th_selection(50, 8, 4, "test")
    assert set(selected.inputs) <= sets[2] and set(selected.targets) <= sets[0]
    assert len(selected.inputs) == 8 and len(selected.targets) == 4


def test_first_96_takes_every_8th_as_target_and_even_inputs_of_the_others():
    selected = first_96_selection(300, 32, 8, "test")
    assert selected.targets == [0, 8, 16, 24, 32, 40, 48, 56, 64, 72, 80, 88]
    # Positions 0, 2, 5, 8, 10, 13, 16, ... (2.68 apart, truncated) of the 84 others.
    assert selected.inputs[:8] == [1, 3, 6, 10, 12, 15, 19, 21]
    assert selected.inputs[-3:] == [89, 92, 95] and len(set(selected.inputs)) == 32
    assert selected == first_96_selection(96, 32, 8, "test")
    assert not set(selected.inputs) & set(selected.targets)


@pytest.mark.medium
@pytest.mark.parametrize("selection", ["every_8th", "kmeans", "first_96"])
def test_validation_shares_no_image_with_the_test(selection):
    cameras = cameras_at(np.random.default_rng(0).normal(size=(70, 3)))
    selected = named_selection(selection, cameras, 8, 4, "val")
    assert len(selected.inputs) == 8 and len(selected.targets) == 4
    assert not set(selected.inputs + selected.targets) & set(held_out(70, "test"))
    assert set(selected.targets) <= set(held_out(70, "val"))
    tested = named_selection(selection, cameras, 8, 4, "test")
    assert not set(tested.targets) & set(training_images(70))


def test_unknown_selections_and_short_sequences_are_named():
    cameras = cameras_at(torch.rand(20, 3))
    assert named_selection("uniform", cameras, 5, 4, "test") == uniform_selection(20, 5, 4)
    with pytest.raises(InputError, match=r"data\.selection is 'k_means': expected one of every_8"):
        named_selection("k_means", cameras, 4, 4, "test")
    for selection in ("every_8th", "kmeans", "first_96"):
        with pytest.raises(InputError, match=r"20 images, of which 1\d are not .*data\.inputs"):
            named_selection(selection, cameras, 19, 4, "test")


MIDDLES = [5, 14, 23, 33]


def planted():
    """Four clusters of nine cameras; of those that are no target, MIDDLES stand at their means."""
    rng = np.random.default_rng(1)
    centers = np.repeat([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]], 9, axis=0)
    for first in range(0, 36, 9):
        rows = [i for i in range(first, first + 9) if i % 8 and i not in MIDDLES]
        offsets = rng.normal(size=(len(rows), 3))
        centers[rows] += offsets - offsets.mean(0)
    return cameras_at(centers)


def test_kmeans_finds_the_middle_of_planted_clusters():
    selected = kmeans_selection(planted(), 4, 2, "test")
    assert selected == Selection(MIDDLES, [0, 8, 16, 24, 32])


def test_kmeans_separates_directions_too():
    """Two places, and at each cameras that look left and right."""
    place = np.arange(40) % 10 // 5
    look = np.arange(40) // 20
    rng = np.random.default_rng(0)
    centers = place[:, None] * np.array([2.0, 0, 0]) + 0.05 * rng.normal(size=(40, 3))
    forwards = np.stack((2 * look - 1.0, 0 * look, 0 * look + 0.3), -1)
    selected = kmeans_selection(cameras_at(centers + 1, forwards), 4, 4, "test")
    assert {(place[i], look[i]) for i in selected.inputs} == {(0, 0), (0, 1), (1, 0), (1, 1)}


def circle(count=120):
    angle = np.arange(count) * 2 * np.pi / count
    centers = np.stack((np.sin(angle), 0 * angle, np.cos(angle)), -1)
    return cameras_at(3 * centers, -centers)


def line(count=100):
    return cameras_at(np.arange(count)[:, None] * [0.1, 0, 0])


SCENES = {
    **{"planted": planted, "circle": circle, "line": line},
    "procedural": lambda: ProceduralScene(3, 4, 4, 96).cameras.to(torch.float64),
}


@pytest.mark.parametrize("scene", SCENES)
def test_kmeans_inputs_do_not_change_with_float_noise(scene):
    cameras = SCENES[scene]()
    selected = kmeans_selection(cameras, 4 if scene == "planted" else 16, 4, "test")
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(size=cameras.cam_to_world[:, :3].shape)
        moved = cameras.cam_to_world.clone()
        moved[:, :3] += 1e-9 * torch.tensor(noise)  # as between libraries of linear algebra
        again = Cameras(cameras.intrinsics, moved, 4, 4)
        assert kmeans_selection(again, len(selected.inputs), 4, "test") == selected


def test_kmeans_spreads_inputs_over_a_circle_and_a_walk():
    """The same on every machine."""
    found = [kmeans_selection(scene, 8, 4, "test").inputs for scene in (circle(), line())]
    assert found == [[1, 15, 31, 47, 62, 75, 89, 103], [6, 19, 34, 49, 62, 74, 85, 95]]


def test_kmeans_chooses_no_image_twice():
    """Four places with eight equal cameras each."""
    features = np.repeat(np.eye(4, 6), 8, axis=0)
    for count in (1, 7, 31):
        rows = nearest_to_centers(features, count)
        assert len(set(rows)) == len(rows) == count
        assert count < 4 or {row // 8 for row in rows} == set(range(4)), count


def test_features_of_kmeans_are_positions_in_the_units_of_the_data_and_directions():
    cameras = planted()
    features = pose_features(cameras)
    centers = cameras.centers.numpy()
    np.testing.assert_allclose(features[:, :3], centers - centers.mean(0), atol=1e-3)
    np.testing.assert_allclose(features[:, 3:], cameras.cam_to_world[:, :3, 2], atol=1e-4)
    far = pose_features(cameras_at(1e3 * centers))
    np.testing.assert_allclose(far[:, :3], 1e3 * features[:, :3], atol=1e-1)
    still = pose_features(cameras_at(np.full((5, 3), 7.1)))
    assert np.array_equal(still[:, :3], np.zeros((5, 3)))


def test_kmeans_gives_the_published_inputs_of_a_real_walk(shared):
    """Long-LRM's own list, of its example scene."""
    file = shared / "data/mydesk/opencv_cameras.json"
    if not file.is_file():
        pytest.skip(f"{file} is absent")
    frames = json.loads(file.read_text())["frames"]
    poses = np.linalg.inv([frame["w2c"] for frame in frames])
    cameras = Cameras(torch.eye(3).double().repeat(498, 1, 1), torch.tensor(poses), 4, 4)
    published = select_from_index(read_index(file, 32), file, "mydesk", 498, 32)
    assert kmeans_selection(cameras, 32, 8, "test") == published
    assert published.targets == list(range(0, 498, 8)) and len(published.inputs) == 32


def test_pixelsplat_s_index_gives_inputs_and_targets(tmp_path):
    file = tmp_path / "index.json"
    file.write_text('{"5aca": {"context": [2, 9], "target": [2, 4, 9]}, "322": null}')
    index = read_index(file, 2)
    assert list(index) == ["5aca"]
    assert select_from_index(index, file, "5aca", 10, 2) == Selection([2, 9], [2, 4, 9])
    with pytest.raises(InputError, match=r"index\.json, scene 5aca has 2 inputs and data\.inputs"):
        select_from_index(index, file, "5aca", 10, 3)
    with pytest.raises(InputError, match="names image 9, and the scene has 9 images"):
        select_from_index(index, file, "5aca", 9, 2)


def test_zipsplat_s_index_is_read_and_written_in_pixelsplat_s_form(tmp_path):
    """Its images count from 0 in the order of a scene's photographs; some are input and target."""
    file, ours = tmp_path / "ctx_3v_tgt_2v.json", tmp_path / "index.json"
    file.write_text(
        '{"bicycle": {"context": [0, 5, 11], "target": [1, 7]}, '
        '"032dee9f": {"context": [2, 15, 24], "target": [0, 15]}}'
    )
    expected = {
        "bicycle": Selection([0, 5, 11], [1, 7]),
        "032dee9f": Selection([2, 15, 24], [0, 15]),
    }
    index = read_index(file, 3)
    assert {name: select_from_index(index, file, name, 25, 3) for name in index} == expected
    write_index(ours, expected)
    assert json.loads(ours.read_text()) == json.loads(file.read_text())


def test_long_lrm_s_lists_give_inputs_and_every_8th_target(tmp_path):
    for scene in "ab":
        content = {"scene_name": scene, "frames": [{}] * 20, "fold_8_kmeans_2_input": [3, 12]}
        (tmp_path / scene).mkdir()
        (tmp_path / scene / "opencv_cameras.json").write_text(json.dumps(content))
    expected = Entry([3, 12], 8)
    index = read_index(tmp_path, 2)
    assert index == {"a": expected, "b": expected}
    assert read_index(tmp_path / "a/opencv_cameras.json", 2) == {"a": expected}
    assert select_from_index(index, tmp_path, "a", 20, 2) == Selection([3, 12], [0, 8, 16])


def test_long_lrm_s_published_file_is_read(tmp_path):
    """The form of its dl3dv_fold_8_kmeans_input_idx.json, which has no cameras."""
    file = tmp_path / "dl3dv_fold_8_kmeans_input_idx.json"
    lists = {"fold_8_kmeans_2_input": [3, 12], "fold_8_kmeans_3_input": [1, 2, 3]}
    scenes = [
        {"scene_name": "032d", **lists},
        {"scene_name": "0569", "fold_8_kmeans_2_input": [5, 17]},
    ]
    file.write_text(json.dumps(scenes))
    index = read_index(file, 2)
    assert select_from_index(index, file, "0569", 18, 2) == Selection([5, 17], [0, 8, 16])
    with pytest.raises(InputError, match="scene 0569 has no list fold_8_kmeans_3_input"):
        read_index(file, 3)


def test_an_unusable_index_is_named(tmp_path):
    (tmp_path / "index.json").write_text('{"a": {"context": [1, 1], "target": [2]}}')
    with pytest.raises(InputError, match=r"index\.json.*different image numbers"):
        read_index(tmp_path / "index.json", 2)


@pytest.mark.medium
def test_the_command_writes_an_index_outside_of_the_data_set(folder, tmp_path, capsys):
    scenes, file = folder("scenes", 3, 4), tmp_path / "index.json"
    index_command([scenes, str(file), "--inputs", "4"])
    assert "2 scenes" in capsys.readouterr().out
    expected = kmeans_selection(ProceduralScene(4, 8, 8, num_images=24).cameras, 4, 8, "test")
    assert select_from_index(read_index(file, 4), file, "s4", 24, 4) == expected
    with pytest.raises(InputError, match=r"index\.json exists"):
        write_index(file, {})
    with pytest.raises(SystemExit, match="lies in the data set"):
        index_command([scenes, f"{scenes}/index.json", "--inputs", "4"])
    assert sorted(path.name for path in (tmp_path / "scenes").iterdir()) == ["s3", "s4"]
