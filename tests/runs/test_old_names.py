"""A run that an earlier version of the code wrote is read under today's names.

old_run/ has the files of a finished run of two stages and of its evaluation; .hydra/overrides.yaml
is its command, and targets.txt lists the classes that the conf/ of that version named.
"""

import json
import shutil
from pathlib import Path

import pytest
import torch
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf
from tiny_runs import finished

from asysplat import load, render
from asysplat.evaluation.metrics import psnr
from asysplat.runs.old_names import CLASSES, KEYS
from asysplat.runs.run_config import read_config
from asysplat.runs.runs import config_hash, find_run
from paper.fill import finished_runs

OLD_RUN = Path(__file__).parent / "old_run"
LATER = {"allow_missing_losses", "training.loss.allow_missing"}  # options without effect on it
LATER |= {"farthest", "stages.stage3.prune_ratio", "data.first_window", "data.growth_steps"}
LATER |= {"windows", *(f"windows.{stage}" for stage in ("stage1", "stage2", "stage3", "ablation"))}
LATER |= {"training.loss.depth_term.stride"}
LATER |= {"stages.stage1.growth_steps", "stages.ablation.growth_steps"}


def overrides_of_today() -> list[str]:
    """The command of the old run, under today's names, with the defaults of its day."""
    renamed = {old: f"{old.rpartition('.')[0]}.{new}" for old, new in KEYS.items()}
    pairs = [o.split("=", 1) for o in OmegaConf.load(OLD_RUN / ".hydra" / "overrides.yaml")]
    today = [f"{renamed.get(key, key)}={value}" for key, value in pairs]
    defaults = ["model=asysplat_plane_sweep", "model.head.sh_degree=1"]
    defaults += ["training/depth=every_second", "training.loss.depth=0.03"]
    defaults += ["training/optimizer=adamw", "stages.stage1.learning_rate=1e-3"]
    return [*defaults, *today]


@pytest.fixture
def old_run(tmp_path) -> Path:
    return shutil.copytree(OLD_RUN, tmp_path / "old_run")


@pytest.fixture
def config(composed):
    return composed(*overrides_of_today(), "paths.run=unused")


@pytest.mark.medium
def test_a_sweep_and_the_report_find_it(old_run, config):
    run = find_run(old_run.parent, config)
    assert run.folder == old_run
    assert run.results["test/procedural/psnr"] == pytest.approx(13.95, abs=0.01)
    assert run.results["stage1/test/procedural/psnr"] == pytest.approx(13.95, abs=0.01)
    for key in (
        "baseline/procedural/mean_color/psnr",
        "early_exit/outdoors/layers",
        "test/rooms/post1/psnr",
    ):
        assert key in run.results
    (reported,) = finished_runs(old_run.parent)[config_hash(config)]
    assert reported == run
    other = config.copy()
    other.stages.stage1.steps = 7
    assert find_run(old_run.parent, other) is not None  # steps=2 is the same for all stages
    other.earlier_stages = []
    assert find_run(old_run.parent, other) is None


def test_its_checkpoint_loads(old_run):
    net = load(str(old_run / "checkpoints" / "last.ckpt"))
    saved = torch.load(old_run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    for name, tensor in net.state_dict().items():
        assert torch.equal(tensor, saved[f"net.{name}"])


TARGETS = set((OLD_RUN / "targets.txt").read_text().split())
TARGETS.remove("asysplat.training.callbacks.Skipped")  # a part of Metrics


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_every_class_of_the_old_configuration_is_there(target):
    assert get_object(CLASSES.get(target, target))


def test_its_configuration_has_the_keys_of_today(old_run, config):
    def paths(node, prefix=""):
        for key in node:
            yield f"{prefix}{key}"
            if OmegaConf.is_dict(node[key]):
                yield from paths(node[key], f"{prefix}{key}.")

    assert set(paths(read_config(old_run / "config.yaml"))) == set(paths(config)) - LATER


@pytest.mark.medium
def test_it_is_evaluated_resumed_and_started_from(old_run, config, run_script, train):
    last = old_run / "checkpoints" / "last.ckpt"
    result = run_script("evaluate.py", f"run={old_run}", "post_optimization_steps=[0]")
    assert result.returncode == 0, result.stderr
    found = json.loads((old_run / "evaluation.json").read_text())
    # Not what the run wrote: the prior is better since.
    data = instantiate(config.data)
    data.setup()
    inputs, targets = (data.tests["procedural"][0][part] for part in ("inputs", "targets"))
    with torch.no_grad():
        shown = render(load(str(last))(inputs), targets.cameras, inputs.mean_color())
    expected = psnr(shown.image.clamp(0, 1), targets.images).mean().item()
    assert found["test/procedural/post0/psnr"] == pytest.approx(expected, rel=1e-4)
    options = [*overrides_of_today(), "logger=none", "data.test_sets=null", "callbacks.costs=null"]
    finished(train(*options, f"init_path={last}", "earlier_stages=[]"))
    (old_run / "metrics.json").unlink()
    result = train(*options, f"ckpt_path={last}", "steps=3")
    assert result.returncode == 0, result.stderr
    assert f"run: {old_run}" in result.stdout
    assert torch.load(last, map_location="meta", weights_only=True)["global_step"] == 3


@pytest.mark.medium
def test_a_checkpoint_that_cannot_be_restored_is_a_sentence(old_run, train):
    """As of an optimizer that had other parts, in an earlier version or in a stranger's file."""
    last = old_run / "checkpoints" / "last.ckpt"
    stored = torch.load(last, weights_only=True)
    del stored["optimizer_states"][0]["param_groups"][0]["params"]
    torch.save(stored, last)
    (old_run / "metrics.json").unlink()
    options = [*overrides_of_today(), "logger=none", "data.test_sets=null", "callbacks.costs=null"]
    result = train(*options, f"ckpt_path={last}", "steps=3")
    expected = f"error: ckpt_path={last} cannot be resumed (KeyError('params')): init_path in place"
    assert result.stderr.splitlines()[-1].startswith(expected) and result.returncode == 1
    assert "Traceback" not in result.stderr
