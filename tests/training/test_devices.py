"""The same global batch on several processes and in micro-batches: the curve of one process."""

import json
from types import SimpleNamespace

import events
import pytest
import torch
from tiny_runs import finished

from asysplat.training.callbacks.weight_average import TRAINED

FEW = [
    *("trainer.accelerator=cpu", "steps=2", "validate_every=1", "data.batch_size=4"),
    *("data.val_scenes=3", "data.test_scenes=3", "data.test_sets=null"),  # odd, of two processes
    *("~callbacks.costs", "~callbacks.figures", "~callbacks.progress", "ema=0.5"),
]
TWO = "trainer.devices=2"


def read_run(result) -> SimpleNamespace:
    """The curves, the test results, the averaged and the last weights of a run."""
    folder = finished(result)
    checkpoint = folder / "checkpoints" / "last.ckpt"
    results = json.loads((folder / "metrics.json").read_text())
    content = torch.load(checkpoint, weights_only=True)
    state = {f"{key}/{n}": t for key in ("state_dict", TRAINED) for n, t in content[key].items()}
    state = {name: t for name, t in state.items() if t.is_floating_point()}  # counters are not
    return SimpleNamespace(
        checkpoint=checkpoint,
        curves={
            name: [value for _, value in row]
            for name, row in events.scalars(folder).items()
            if name.startswith(("train/", "val/", "train/"))
        },
        test={k: v for k, v in results.items() if k.startswith(("test/", "baseline/"))},
        rows=len((folder / "metrics.csv").read_text().splitlines()) - 1,
        weights=torch.cat([state[name].flatten().double() for name in sorted(state)]),
    )


@pytest.fixture(scope="module")
def train(module_train):
    return module_train


@pytest.fixture(scope="module")
def one(train):
    return read_run(train("name=one", "trainer.devices=1", "data.micro_batch=4", *FEW))


def check_the_same(found, expected) -> None:
    """The norm of all gradients is summed in fp32, and by process."""
    assert found.curves.keys() == expected.curves.keys()
    assert {"train/loss", "train/psnr", "train/grad_norm", "val/psnr"} <= found.curves.keys()
    for name, values in expected.curves.items():
        rel = 1e-4 if name == "train/grad_norm" else 1e-5
        assert len(values) == 2 and found.curves[name] == pytest.approx(values, rel=rel), name
    assert found.test == pytest.approx(expected.test, rel=1e-5) and found.test
    assert found.rows == expected.rows == 3 * 2
    assert (found.weights - expected.weights).norm() < 1e-6 * expected.weights.norm()


@pytest.mark.medium
def test_accumulated_micro_batches_take_the_same_steps(train, one):
    result = train("name=accumulated", "trainer.devices=1", "data.micro_batch=1", *FEW)
    assert "global batch 4 = 1 process x 1 scene x 4 accumulated" in result.stdout
    check_the_same(read_run(result), one)


@pytest.mark.medium
def test_two_processes_take_the_same_steps(train, one):
    """Each accumulates, and validates and tests a share of three scenes."""
    result = train.alone("name=two", "trainer=ddp", TWO, "data.micro_batch=1", *FEW)
    assert "global batch 4 = 2 processes x 1 scene x 2 accumulated" in result.stdout
    check_the_same(read_run(result), one)


@pytest.mark.slow
def test_divided_weights_take_the_same_steps(train, one):
    """FSDP takes the same steps, and one process goes on from its checkpoint."""
    saving = ["training.checkpoint_layers=true", "training.views_at_once=1"]
    result = train.alone("name=fsdp", "trainer=fsdp", TWO, "data.micro_batch=1", *saving, *FEW)
    fsdp = read_run(result)
    check_the_same(fsdp, one)
    more = ["steps=3", "trainer.devices=1", "data.micro_batch=4", *FEW[2:]]
    again = [
        read_run(train(f"ckpt_path={run.checkpoint}", "trainer.accelerator=cpu", *more))
        for run in (fsdp, one)
    ]
    assert again[0].curves["train/loss"] == pytest.approx(again[1].curves["train/loss"], rel=1e-5)
    assert (again[0].weights - again[1].weights).norm() < 1e-6 * again[1].weights.norm()
    assert not torch.equal(again[0].weights, fsdp.weights)
