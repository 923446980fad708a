"""Tasks: reproducible, disjoint between splits, normalized, and batched."""

from pathlib import Path

import numpy as np
import pytest
import torch

from asysplat.data import (
    Augmentation,
    ProceduralSource,
    SceneDataModule,
    datamodule,
    files_data,
    procedural_data,
)
from asysplat.data.datamodule import FixedTasks, TrainingTasks, collate, load
from asysplat.data.procedural import ProceduralScene
from asysplat.data.selection import Selection
from asysplat.data.sources import Task
from asysplat.errors import InputError

LOADING = {
    **{"inputs": 3, "targets": 2, "height": 16, "width": 16},
    **{"batch_size": 2, "num_workers": 0, "seed": 5, "steps_per_epoch": 3},
}
OPTIONS = {**LOADING, "window": (12, 24)}


def procedural(**changes):
    source = ProceduralSource(16, 16, 24, (12, 24), val_scenes=1, test_scenes=1)
    return SceneDataModule(**({"name": "procedural", "source": source} | LOADING | changes))


def with_test_sets(test_sets, **changes):
    scenes = {"num_images": 24, "val_scenes": 1, "test_scenes": 2, "places": "both"}
    options = {"name": "procedural", **OPTIONS, **scenes}
    return procedural_data(test_sets=test_sets, **(options | changes))


def set_up(data):
    data.setup()
    return data


def assert_same_cameras(sample, expected):
    assert sample["scene"] == expected["scene"]
    for views in ("inputs", "targets"):
        poses = (each[views].cameras.cam_to_world for each in (sample, expected))
        assert torch.equal(*poses)


class Trainer:
    def __init__(self, epoch, global_rank=0, world_size=1):
        self.current_epoch, self.global_rank, self.world_size = epoch, global_rank, world_size


@pytest.mark.medium
def test_the_steps_of_several_processes_are_those_of_one(monkeypatch):
    """For any micro-batch: two steps of 4 scenes, in the second epoch; also after the first one."""
    monkeypatch.setattr(datamodule.loader, "batches_done", lambda trainer: 0)
    (alone,) = scenes_of_steps(processes=1, micro_batch=4)
    assert len({name for step in alone for name in step}) == 8
    for processes, micro_batch, done in ((2, 2, 0), (2, 1, 0), (2, 2, 1), (2, 1, 2)):
        monkeypatch.setattr(datamodule.loader, "batches_done", lambda trainer, done=done: done)
        steps = zip(*scenes_of_steps(processes, micro_batch), strict=True)
        together = [sorted(name for share in step for name in share) for step in steps]
        assert together == [sorted(step) for step in alone[done > 0 :]]


def scenes_of_steps(processes, micro_batch):
    """The names of each step's scenes, of every process."""
    shares = []
    for rank in range(processes):
        data = procedural(batch_size=4, micro_batch=micro_batch, steps_per_epoch=2)
        data.trainer = Trainer(1, rank, processes)
        names = [batch["scene"] for batch in data.train_dataloader()]
        assert all(len(micro) == micro_batch for micro in names)
        flat, share = [name for micro in names for name in micro], 4 // processes
        shares.append([flat[at : at + share] for at in range(0, len(flat), share)])
    return shares


@pytest.mark.medium
@pytest.mark.parametrize(("scenes", "processes"), [(3, 1), (5, 4), (2, 3)])
def test_no_scene_is_evaluated_by_two_processes(scenes, processes):
    """All have equally many batches; a process with fewer scenes repeats one of its own."""
    source = ProceduralSource(16, 16, 24, (12, 24), val_scenes=scenes, test_scenes=1)
    data, turns = procedural(source=source), []
    data.setup()
    for rank in range(processes):
        data.trainer = Trainer(0, rank, processes)
        turns.append([batch["scene"][0] for batch in data.val_dataloader()])
    assert len({len(own) for own in turns}) == 1
    having = [set(own) for own in turns[:scenes]]
    assert sum(map(len, having)) == len(set().union(*having)) == scenes


@pytest.mark.medium
def test_augmented_tasks_are_repeated_by_their_seed():
    plain, varied = (
        TrainingTasks(procedural(augmentation=augmentation))
        for augmentation in (
            Augmentation(),
            Augmentation(reverse=0.5, shuffle=0.5, crop=0.5, exposure=0.5, noise=0.02),
        )
    )
    assert varied[0]["scene"] != TrainingTasks(procedural(seed=6))[0]["scene"]
    orders = set()
    for index in range(4):
        straight, first, again = plain[index], varied[index], varied[index]
        assert first["scene"] == straight["scene"]
        assert torch.equal(first["inputs"].images, again["inputs"].images)
        focal = [task["inputs"].cameras.intrinsics[0, 0, 0] for task in (straight, first)]
        assert 1 <= focal[1] / focal[0] <= 2
        centers = [task["inputs"].cameras.centers for task in (straight, first)]
        order = torch.cdist(*centers).argmin(1).tolist()
        assert sorted(order) == [0, 1, 2]
        torch.testing.assert_close(centers[1][order], centers[0])
        orders.add(tuple(order))
        targets = [task["targets"].cameras.centers for task in (straight, first)]
        torch.testing.assert_close(*targets)
    assert len(orders) > 1


class Counting:
    """A sequence that lists the images that were decoded."""

    points = None

    def __init__(self, scene):
        self.scene, self.name, self.num_images = scene, scene.name, scene.num_images
        self.cameras, self.decoded = scene.cameras, []

    def views(self, indices):
        self.decoded += indices
        return self.scene.views(indices)


def test_an_input_that_is_a_target_is_decoded_once():
    sequence = Counting(ProceduralScene(3, 16, 16, num_images=24))
    sample = load(Task(sequence, Selection([9, 2, 5], [5, 7, 9])))
    assert sorted(sequence.decoded) == [2, 5, 7, 9]
    images = sequence.scene.views([9, 2, 5, 7]).images
    assert torch.equal(sample["inputs"].images, images[:3])
    assert torch.equal(sample["targets"].images, images[[2, 3, 0]])


def test_fixed_tasks_stay_loaded_up_to_a_limit():
    sequences = [Counting(ProceduralScene(seed, 16, 16, num_images=24)) for seed in range(3)]
    tasks = [Task(sequence, Selection([0, 1], [2])) for sequence in sequences]
    fixed = FixedTasks(tasks, room=1.5 * 3 * 3 * 16 * 16 * 4)
    assert [len(sequence.decoded) for sequence in sequences] == [3, 3, 0]
    for _ in range(2):
        assert [sample["scene"] for sample in fixed] == [sequence.name for sequence in sequences]
    assert [len(sequence.decoded) for sequence in sequences] == [3, 3, 6]


def test_a_process_keeps_its_share_of_the_fixed_tasks():
    sequences = [Counting(ProceduralScene(seed, 16, 16, num_images=24)) for seed in range(3)]
    tasks = [Task(sequence, Selection([0, 1], [2])) for sequence in sequences]
    fixed = FixedTasks(tasks, process=(1, 2))
    assert [len(sequence.decoded) for sequence in sequences] == [0, 3, 0]
    assert fixed.num_bytes == 3 * 3 * 16 * 16 * 4


@pytest.mark.medium
def test_a_test_set_differs_only_in_its_options():
    data = set_up(with_test_sets({"rooms": {"places": "rooms"}, "more_views": {"inputs": 5}}))
    assert list(data.tests) == ["procedural", "rooms", "more_views"]
    for scenes, loader in zip(data.tests.values(), data.test_dataloader(), strict=True):
        batches = [batch["scene"] for batch in loader]
        assert batches == [[scene["scene"]] for scene in scenes] and len(scenes) == 2
    assert data.tests["procedural"] is data.evaluation["test"]
    views = {name: scenes[0]["inputs"].num_views for name, scenes in data.tests.items()}
    assert views == {"procedural": 3, "rooms": 3, "more_views": 5}


@pytest.mark.medium
def test_an_unusable_test_set_is_named():
    for test_sets, message in (
        ({"far": {"palces": "rooms"}}, r"\.far\.palces is no"),
        ({"procedural": {}}, r"\.procedural has the name"),
        ({"far": {"places": "caves"}}, r"\.far: data\.places is"),
        ({"far": {"inputs": 30}}, r"\.far: .* 24 images"),
    ):
        with pytest.raises(InputError, match=rf"data\.test_sets{message}"):
            with_test_sets(test_sets).setup()


@pytest.mark.medium
def test_tests_may_have_another_size_than_training():
    """The same scenes and images, larger; a test set keeps a size of its own."""
    sets = {"rooms": {"places": "rooms"}, "wide": {"height": 16, "width": 32}}
    data = set_up(with_test_sets(sets, test_size=[32, 48]))
    small = set_up(with_test_sets(sets))
    sizes = {name: tasks[0]["inputs"].images.shape[-2:] for name, tasks in data.tests.items()}
    assert sizes == {"procedural": (32, 48), "rooms": (32, 48), "wide": (16, 32)}
    for sample in (TrainingTasks(data)[0], data.evaluation["val"][0]):
        assert sample["inputs"].images.shape[-2:] == (16, 16)
    for sample, expected in zip(data.tests["procedural"], small.tests["procedural"], strict=True):
        assert_same_cameras(sample, expected)
    checked = []
    data.check_sizes(lambda *size: checked.append(size))
    assert set(checked) == {(16, 16), *sizes.values()}

    def refuse(height, width):
        if width == 32:
            raise InputError("too wide.")

    with pytest.raises(InputError, match=r"^data\.test_sets\.wide: too wide\.$"):
        data.check_sizes(refuse)


@pytest.mark.medium
def test_test_sets_are_those_whose_path_and_name_are_set(written):
    root = f"{written}/s3"
    sets = {"here": {"root": root, "selection": "kmeans"}, "nowhere": {"root": None}}
    assert not with_test_sets(sets).test_sets
    own = {"root": root, "name": "own", "on_error": "fail"} | OPTIONS
    same = {"own": {"root": "elsewhere"}, "more": {"inputs": 5}}
    with pytest.warns(UserWarning, match=r"their paths are not set: nowhere\. .* paths\.no"):
        data = files_data(test_sets=sets | same, **own)
    assert list(data.test_sets) == ["here", "more"]
    with pytest.raises(InputError, match=r"data\.test_sets\.own has the name of the data"):
        files_data(test_sets={"own": {"inputs": 5}}, **own)


@pytest.mark.medium
def test_the_root_of_a_test_set_is_what_it_tests_beside_a_test_root(folder):
    far = {"root": folder("other", 7), "selection": "kmeans"}
    options = {"root": folder("train", 3, 4, 5), "test_root": folder("test", 6), "val_scenes": 1}
    data = set_up(
        files_data(name="files", test_sets={"far": far, "more": {}}, **options, **OPTIONS)
    )
    scenes = {name: [sample["scene"] for sample in tasks] for name, tasks in data.tests.items()}
    assert scenes == {"files": ["s6"], "far": ["s7"], "more": ["s6"]}
    # Every 8th of 24 images, where the data set itself takes two of them.
    targets = {name: tasks[0]["targets"].num_views for name, tasks in data.tests.items()}
    assert targets == {"files": 2, "far": 3, "more": 2}
    alone = set_up(files_data(name="far", **far, **OPTIONS))
    (scene,), (expected,) = data.tests["far"], alone.evaluation["test"]
    assert torch.equal(scene["targets"].images, expected["targets"].images)
    drawn = {TrainingTasks(data)[index]["scene"] for index in range(20)}
    (validated,) = (sample["scene"] for sample in data.evaluation["val"])
    assert drawn | {validated} == {"s3", "s4", "s5"} and validated not in drawn


@pytest.mark.medium
def test_files_are_tested_on_the_same_images_at_another_size(folder):
    options = {"name": "files", "root": folder("all", 3, 4, 5), "val_scenes": 1, **OPTIONS}
    data, plain = set_up(files_data(**options, test_size=[8, 8])), set_up(files_data(**options))
    assert len(data.tests["files"]) == 3
    for sample, expected in zip(data.tests["files"], plain.tests["files"], strict=True):
        assert sample["targets"].images.shape[-2:] == (8, 8)
        assert_same_cameras(sample, expected)


@pytest.fixture
def folders(folder, written):
    """Scenes s3, s4 and s5 to train on, and a test; every image of s4 is cut short."""
    root = folder("train", 3, 4, 5)
    for image in Path(root, "s4", "images").iterdir():
        image.write_bytes(image.read_bytes()[:100])
    return {"name": "files", "root": root, "test_root": str(written / "s6"), "val_scenes": 1}


@pytest.mark.medium
def test_another_scene_is_drawn_where_one_cannot_be_read(folders):
    options = {**folders, **OPTIONS}
    with pytest.raises(InputError, match=r"train/s4/images/\S+ cannot be read as an image"):
        for index in range(20):
            TrainingTasks(files_data(**options))[index]

    tasks = TrainingTasks(files_data(**options, on_error="skip"))
    samples = [tasks[index] for index in range(20)]
    counts = [len(sample["bad_scenes"]) for sample in samples]
    assert {"s4"}.isdisjoint(sample["scene"] for sample in samples)
    assert 0 in counts and sum(counts) >= 5
    assert all("s4 has 0 usable" in each for sample in samples for each in sample["bad_scenes"])
    batch = collate(samples)
    assert len(batch["bad_scenes"]) == sum(counts)
    again = files_data(**options, on_error="skip")
    for index, sample in enumerate(samples):
        assert torch.equal(TrainingTasks(again)[index]["inputs"].images, sample["inputs"].images)


def test_training_without_a_scene_that_can_be_read_ends(folders):
    for image in Path(folders["root"]).rglob("images/*"):
        image.unlink()
    data = files_data(**folders, **OPTIONS, on_error="skip")
    with pytest.raises(InputError, match=r"^10 training scenes in a row cannot be used, .*/train/"):
        TrainingTasks(data)[0]


def test_the_window_grows_step_by_step(monkeypatch):
    """From 6 images at the first of 10 steps, of 2 tasks each, to 24."""
    source = ProceduralSource(16, 16, 24, (24, 24), 1, 1, first_window=(6, 6))
    tasks, draw, spans = (
        TrainingTasks(procedural(source=source, growth_steps=10)),
        source.training,
        [],
    )

    def record(_, *given):
        task = draw(*given)
        spans.append(np.ptp(task.selection.inputs) + 1)
        return task

    monkeypatch.setattr(ProceduralSource, "training", record)
    for index in (0, 10, 20, 40):
        tasks[index]
    assert spans == [6, 15, 24, 24]
