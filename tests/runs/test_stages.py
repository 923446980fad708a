"""Several stages in one run: their options, their weights, and how a stopped run resumes."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from tiny import NETWORK, SCENES
from tiny_runs import finished

from asysplat.errors import InputError
from asysplat.runs.runs import config_hash, find_run, find_runs
from asysplat.runs.stages import check_stages, resume_point, stage_configs
from asysplat.training import SplattingModule

NAMES = ["stage1", "stage2", "stage3"]
THREE = ["experiment=three_stages", "paths.run=runs/a"]


@pytest.fixture
def composed(composed):
    return partial(composed, *THREE)


def test_the_papers_three_stages(composed):
    """Sec. 4.2 and Suppl. A; 540 is 544 here, and the crop of the last is Long-LRM's."""
    found = stage_configs(composed("scale=paper", "data=dl3dv"))
    expected = {
        "stage": NAMES,
        "data.height": [256, 512, 544],
        "data.width": [256, 512, 960],
        "steps": [60_000, 10_000, 10_000],
        "training.optimizer.lr": [4e-4, 4e-5, 4e-5],
        "training.schedule.warmup_steps": [2000, 0, 0],
        "training.schedule.total_steps": [60_000, 10_000, 10_000],
        "training.optimizer.weight_decay": [0.05] * 3,
        "data.augmentation.crop": [1.0, 1.0, 0.77],
    }
    for key, values in expected.items():
        assert [OmegaConf.select(config, key) for config in found] == values, key


@pytest.mark.medium
@pytest.mark.parametrize("scale", ["laptop", "gpu", "paper"])
def test_every_scale_has_them_and_tests_them_alike(composed, scale):
    config = composed(f"scale={scale}", "data=dl3dv")
    found = stage_configs(config)
    assert [stage.stage for stage in found] == NAMES
    # The end of each is measured.
    assert all(stage.steps % stage.validate_every == 0 for stage in found)
    tested = [stage.data.test_size for stage in found[:-1]]
    assert tested == [[config.data.height, config.data.width]] * 2
    assert found[-1] is config and config.data.test_size is None
    check_stages(found)
    alone = composed("stage=stage1", "earlier_stages=[]")
    assert stage_configs(alone) == [alone]


@pytest.mark.medium
def test_the_hash_covers_all_stages(composed):
    runs = [[], ["stages.stage1.steps=7"], ["+stages.stage2.crop=0.5"], ["earlier_stages=[stage2]"]]
    runs += [["earlier_stages=[stage2,stage1]"], ["earlier_stages=[]"], ["stage=ablation"]]
    hashes = [config_hash(composed("scale=paper", *overrides)) for overrides in runs]
    assert len(set(hashes)) == len(runs)
    assert config_hash(composed("scale=paper", "stages.ablation.steps=7")) == hashes[0]


REFUSED = {
    "an unknown stage": (["earlier_stages=[stage1,stage4]"], "earlier_stages names stage4, which"),
    "a size between patches": (["stages.stage3.height=40"], r"stage3: .* 40x\d+, .* set 48x"),
    "no checkpoints": (["callbacks.checkpoints=null"], "leave it in, or train one stage"),
}


@pytest.mark.medium
@pytest.mark.parametrize("case", REFUSED)
def test_a_mistake_in_any_stage_is_refused_at_once(composed, case):
    overrides, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        check_stages(stage_configs(composed(*overrides)))


def test_a_run_resumes_in_the_stage_of_its_checkpoint(composed, tmp_path):
    stages, path = stage_configs(composed()), tmp_path / "last.ckpt"

    def saved(**record):
        torch.save({"callbacks": {"StageRecord": record} if record else {}}, path)
        return path

    earlier = {"stage1/test/procedural/psnr": 20.0}
    assert resume_point(None, stages) == (0, {})
    assert resume_point(saved(stage="stage2", earlier=earlier), stages) == (1, earlier)
    assert resume_point(saved(), stages) == (0, {})
    with pytest.raises(InputError, match=r"last\.ckpt is of ablation, and this run trains"):
        resume_point(saved(stage="ablation", earlier={}), stages)
    path.write_text("a text")
    with pytest.raises(InputError, match=r"last\.ckpt cannot be read as a checkpoint to resume"):
        resume_point(path, stages)


TINY = ["experiment=three_stages", *NETWORK, "steps=2", "validate_every=1", "data.inputs=3"]
TINY += [*SCENES, "data.targets=2", "data.num_workers=0", "data.test_sets=null"]
TINY += [f"stages.{name}.height=32" for name in NAMES]
TINY += [f"stages.{name}.width={width}" for name, width in zip(NAMES, (32, 48, 64), strict=True)]
TINY += ["stages.stage3.learning_rate=1e-12"]
TINY += [f"callbacks.{name}=null" for name in ("costs", "figures", "curve")]
PREFIXES = ("stage1/", "stage2/", "")  # of folders and results


def saved_in(folder: Path) -> dict:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def train(logs, run_script):
    return lambda *overrides: run_script("train.py", *TINY, f"paths.logs={logs}", *overrides)


@pytest.fixture(scope="module")
def whole(train) -> Path:
    """The folder of a finished run of three stages, of two steps each."""
    return finished(train("name=whole"))


@pytest.mark.medium
def test_a_run_of_three_stages_is_one_run(whole, logs, composed):
    (run,) = find_runs(whole)
    numbers, config = run.results, yaml.safe_load((whole / "config.yaml").read_text())
    assert (config["stage"], config["earlier_stages"]) == ("stage3", NAMES[:2])
    nearest = set()
    for prefix, width in zip(PREFIXES, (32, 48, 64), strict=True):
        folder = whole / prefix
        assert yaml.safe_load((folder / "config.yaml").read_text())["data"]["width"] == width
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        psnrs = [float(row["psnr"]) for row in rows]
        psnr = numbers[f"{prefix}test/procedural/psnr"]
        assert abs(sum(psnrs) / len(psnrs) - psnr) < 1e-4
        # Of the same images in every stage: what needs no training is the same.
        nearest.add(tuple(row["nearest_view/psnr"] for row in rows))
        assert list((folder / "tensorboard").glob("events.*"))
    assert len(nearest) == 1
    assert find_run(logs, composed(*TINY[1:])).folder == whole


@pytest.mark.medium
def test_stages_share_weights_but_not_the_optimizer(whole):
    first, second, third = (saved_in(whole / name) for name in ("stage1", "stage2", "."))
    for stage in (first, second, third):
        states = stage["optimizer_states"][0]["state"].values()
        steps = {int(state["step"]) for state in states if "step" in state}  # Muon counts none
        assert steps == {stage["global_step"]} == {2}
    groups = [stage["optimizer_states"][0]["param_groups"][0] for stage in (first, third)]
    assert [group["initial_lr"] for group in groups] == [5e-4, 1e-12]
    names = [name for name in second["state_dict"] if name.endswith("weight")]
    assert any(not torch.equal(first["state_dict"][n], second["state_dict"][n]) for n in names)
    for name in names:  # its rate moves nothing
        torch.testing.assert_close(third["state_dict"][name], second["state_dict"][name])


@pytest.mark.medium
def test_a_run_stopped_twice_in_its_second_stage_has_the_same_bits(train, whole, monkeypatch):
    """First before its first step, then between its two."""
    step = SplattingModule.training_step

    def stopped_after(steps: int, *overrides: str) -> None:
        taken = []

        def stopping(module, batch, index):
            if len(taken) == steps:
                raise InputError("stopped")
            taken.append(index)
            return step(module, batch, index)

        with monkeypatch.context() as patch:
            patch.setattr(SplattingModule, "training_step", stopping)
            assert "error: stopped" in train("name=stopped", *overrides).stderr

    stopped_after(2)
    stopped_after(1, "ckpt_path=last")
    resumed = finished(train("name=stopped", "ckpt_path=last"))
    assert [path for path in resumed.parent.iterdir() if path.is_dir()] == [resumed]
    for name in ("stage2", "."):
        found, expected = (saved_in(at / name)["state_dict"] for at in (resumed, whole))
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[key], expected[key]) for key in expected)
    results, expected = (json.loads((at / "metrics.json").read_text()) for at in (resumed, whole))
    tests = {key for key in expected if "test/" in key}
    assert {f"{prefix}test/procedural/psnr" for prefix in PREFIXES} <= tests
    assert {key: results.get(key) for key in tests} == {key: expected[key] for key in tests}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_processes_of_torchrun_train_in_one_folder_and_resume_there(logs, train, repository):
    """They start two seconds apart; where one is killed, all go on later; as one process trains."""
    sizes = ["data.batch_size=4", "data.val_scenes=2", "data.test_scenes=2"]
    options = [*TINY, f"paths.logs={logs}", "trainer=ddp", "trainer.accelerator=cpu"]
    options += ["trainer.devices=4", *sizes]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    launcher += ["--nproc-per-node=4", "tests/late.py", "train.py", *options]
    environ = {**os.environ, "OMP_NUM_THREADS": "1"}

    def launch(name, *more):
        words = [*launcher, f"name={name}", *more]
        return subprocess.Popen(words, cwd=repository, env=environ)

    assert launch("launched").wait() == 0
    process = launch("killed")
    second = lambda: list((logs / "killed").glob("*/stage2/checkpoints/last.ckpt"))  # noqa: E731
    while not second():
        assert process.poll() is None
        time.sleep(0.1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    os.kill(int(children[-1]), signal.SIGKILL)
    assert process.wait() != 0
    assert launch("killed", "ckpt_path=last").wait() == 0
    (whole,), (resumed,) = ([*(logs / name).iterdir()] for name in ("launched", "killed"))
    for name in ("stage1", "stage2", "."):
        found, expected = (saved_in(at / name)["state_dict"] for at in (resumed, whole))
        assert all(torch.equal(found[key], expected[key]) for key in expected)
    alone = finished(train("name=alone", *sizes))
    ours, one = (json.loads((at / "metrics.json").read_text()) for at in (whole, alone))
    for prefix in PREFIXES:
        key = f"{prefix}test/procedural/psnr"
        assert abs(ours[key] - one[key]) < 1e-3
