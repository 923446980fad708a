"""Tasks: reproducible, disjoint between stages, normalised, and batched."""

import numpy as np
import pytest
import torch

from asysplat.data import ProceduralSource, SceneDataModule, TransformsSource
from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.data.procedural import ProceduralScene
from asysplat.data.selection import held_out, held_out_split, trained
from asysplat.data.write import write_transforms
from asysplat.errors import InputError


def procedural(**changes):
    source = ProceduralSource(16, 16, 24, (12, 24), val_scenes=1, test_scenes=1)
    options = {
        **{"name": "procedural", "source": source, "inputs": 3, "targets": 2},
        **{"height": 16, "width": 16, "batch_size": 2, "workers": 0, "seed": 5},
        "steps_per_epoch": 3,
    }
    return SceneDataModule(**(options | changes))


class Trainer:
    world_size = 1

    def __init__(self, epoch):
        self.current_epoch = epoch


def epoch_of_scenes(data, epoch):
    data.trainer = Trainer(epoch)
    return [batch["scene"] for batch in data.train_dataloader()]


def test_an_epoch_is_the_same_however_one_gets_there():
    whole = [epoch_of_scenes(procedural(), epoch) for epoch in range(2)]
    assert epoch_of_scenes(procedural(), 1) == whole[1]
    assert len({name for epoch in whole for names in epoch for name in names}) == 12


def test_another_seed_gives_other_tasks():
    first, other = TrainingTasks(procedural())[0], TrainingTasks(procedural(seed=6))[0]
    assert first["scene"] != other["scene"]
    again = TrainingTasks(procedural())[0]
    assert torch.equal(first["targets"].images, again["targets"].images)


def test_evaluation_scenes_are_never_trained_on():
    data = procedural()
    data.setup()
    evaluated = {sample["scene"] for stage in data.evaluation.values() for sample in stage}
    trained_on = {TrainingTasks(data)[i]["scene"] for i in range(5)}
    assert len(evaluated) == 2 and not evaluated & trained_on


def test_inputs_are_normalised_and_batches_stack():
    tasks = TrainingTasks(procedural())
    batch = collate([tasks[0], tasks[1]])
    centers = batch["inputs"].cameras.centers
    assert centers.shape == (2, 3, 3)
    torch.testing.assert_close(centers.norm(dim=-1).amax(1), torch.ones(2))
    torch.testing.assert_close(centers.mean(1), torch.zeros(2, 3), atol=1e-5, rtol=0)


def test_frames_of_a_folder_are_tested_or_validated_or_trained():
    sets = [set(held_out(50, "test")), set(held_out(50, "val")), set(trained(50))]
    assert set.union(*sets) == set(range(50))
    assert sum(map(len, sets)) == 50
    split = held_out_split(50, 8, 4, "test")
    assert set(split.inputs) <= sets[2] and set(split.targets) <= sets[0]
    assert len(split.inputs) == 8 and len(split.targets) == 4


def test_too_short_a_folder():
    with pytest.raises(InputError, match=r"data\.inputs"):
        held_out_split(6, 8, 4, "test")


def test_a_written_scene_trains_like_the_scene_itself(tmp_path):
    scene = ProceduralScene(3, 16, 16, num_frames=24)
    write_transforms(scene.views(range(24)), tmp_path / "scene")
    source = TransformsSource(str(tmp_path), 16, 16, (12, 24))
    (task,) = source.evaluation("test", 4, 2)
    read = task.capture.views(task.split.targets)
    made = scene.views(task.split.targets)
    assert (read.images - made.images).abs().max() < 1 / 255
    assert (read.depths - made.depths).abs().max() < 1e-3
    torch.testing.assert_close(read.cameras.cam_to_world, made.cameras.cam_to_world)
    torch.testing.assert_close(read.cameras.intrinsics, made.cameras.intrinsics)
    drawn = source.training(4, 2, np.random.default_rng(0)).split
    assert not set(drawn.inputs + drawn.targets) & set(held_out(24, "test") + held_out(24, "val"))


def test_a_folder_without_scenes(tmp_path):
    with pytest.raises(InputError, match=r"data\.root"):
        TransformsSource(str(tmp_path), 16, 16, (12, 24))
