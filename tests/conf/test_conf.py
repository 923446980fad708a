"""Every file under conf/ and sweeps/ composes, builds its model, trains a step, and starts with its
command."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tiny import SCENES, SIZE, VIEWS

from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.refinement import PAPER, PUBLISHED_3DGS, RefinementSettings
from asysplat.report.paper import find_tables

ROOT = Path(__file__).parents[2]
CONF, SWEEPS = ROOT / "conf", ROOT / "sweeps"
GROUPS = [
    (str(path.parent.relative_to(CONF)), path.stem)
    for path in sorted(CONF.rglob("*.yaml"))
    if path.parent not in (CONF, CONF / "refinement", CONF / "quality")
]
# Shared parts of the files that use them.
PARTS = {("model", "asysplat"), ("model", "blocks"), ("model", "one_branch")}
PARTS |= {("data", "views"), ("data", "disk")}
TRAINED = [(group, name) for group, name in GROUPS if group in ("model", "experiment")]
TRAINED += [("sweeps", path.stem) for path in sorted(SWEEPS.glob("*.yaml"))]
STAGES = ("stage1", "stage2", "stage3", "ablation")
TRAINED += [("stage", stage) for stage in STAGES]
TINY = [*SIZE, *VIEWS, *SCENES, "data.test_sets=null", "data.batch_size=1"]


def compose_train(*overrides, script="train"):
    with initialize_config_dir(str(CONF), version_base=None):
        return compose(script, list(overrides), return_hydra_config=True)


def first_rows(config) -> list[str]:
    """List the first choice of every key that a sweep varies."""
    return [f"{k}={str(v).split(',')[0]}" for k, v in config.hydra.sweeper.params.items()]


@pytest.mark.parametrize("group", sorted(set(GROUPS) - PARTS), ids="/".join)
def test_composes_and_builds_its_model(group):
    config = compose_train("=".join(group))
    with torch.device("meta"):
        net = instantiate(config.model)
    assert sum(p.numel() for p in net.parameters()) > 1e6


def test_refinement_files_equal_the_defaults_of_the_code():
    names = {path.stem for path in (CONF / "refinement").glob("*.yaml")}
    coded = {"default": RefinementSettings(), "paper": PAPER, "3dgs": PUBLISHED_3DGS}
    assert names == coded.keys()
    for name, expected in coded.items():
        config = compose_train(f"refinement={name}", script="reconstruct")
        assert instantiate(config.refinement) == expected


def test_qualities_raise_everything_together():
    names = ("preview", "good", "best")
    configs = [compose_train(f"quality={name}", script="reconstruct") for name in names]
    for key in ("height", "views", "seconds", "refinement.max_gaussians"):
        values = [OmegaConf.select(config, key) for config in configs]
        assert values == sorted(set(values)), key


@pytest.mark.medium
@pytest.mark.parametrize("path", sorted(SWEEPS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_row_of_a_sweep_builds_its_model(path):
    config = compose_train(f"sweeps={path.stem}")
    assert config.hydra.mode.name == "MULTIRUN"
    assert config.name == path.stem
    choices = dict(config.hydra.sweeper.params)
    choices.pop("seed", None)
    assert choices
    for key, values in choices.items():
        for value in values.split(","):
            row = compose_train(f"sweeps={path.stem}", f"{key}={value}")
            with torch.device("meta"):
                instantiate(row.model)


@pytest.mark.medium
@pytest.mark.parametrize("choice", sorted(set(TRAINED) - PARTS), ids="/".join)
def test_trains_a_step_at_a_tiny_size(choice):
    overrides = ["=".join(choice), *TINY]
    if choice[0] == "sweeps":
        overrides += first_rows(compose_train(overrides[0]))
    config = compose_train(*overrides)
    data = instantiate(config.data)
    module = instantiate(config.training, net=instantiate(config.model))
    batch = collate([TrainingTasks(data)[0]])
    optimizer = module.configure_optimizers()["optimizer"]
    before = [parameter.detach().clone() for parameter in module.net.head.parameters()]
    prediction = module(batch, depth=module.loss.needs_depth)
    loss = module.loss(prediction, batch)["loss"]
    loss.backward()
    optimizer.step()
    assert loss.isfinite()
    # Otherwise processes that train together would wait for the gradient.
    assert all(p.grad is not None for p in module.parameters() if p.requires_grad)
    changed = zip(before, module.net.head.parameters(), strict=True)
    assert all(not torch.equal(old, new) and new.isfinite().all() for old, new in changed)


@pytest.mark.parametrize(
    "path",
    sorted(CONF.rglob("*.yaml")) + sorted(SWEEPS.glob("*.yaml")),
    ids=lambda path: path.stem,
)
def test_first_comment_is_the_command(path):
    comments = [line for line in path.read_text().splitlines()[:2] if line.startswith("# ")]
    scripts = {name: f"{name}.py" for name in ("report", "benchmark", "evaluate", "reconstruct")}
    scripts |= dict.fromkeys(("refinement", "quality"), "reconstruct.py")  # folders
    script = scripts.get(path.stem, scripts.get(path.parent.stem, "train.py"))
    assert any(f"python {script}" in comment for comment in comments)


@pytest.mark.parametrize("scale", ["laptop", "gpu", "paper"])
def test_a_stage_sets_the_sizes_of_its_scale(scale):
    for stage in STAGES:
        config = compose_train(f"scale={scale}", f"stage={stage}")
        assert set(config.stages) == set(STAGES)
        expected = config.stages[stage]
        data, training = config.data, config.training
        assert (data.height, data.width) == (expected.height, expected.width)
        assert (data.batch_size, config.steps) == (expected.batch_size, expected.steps)
        assert training.optimizer.lr == config.learning_rate == expected.learning_rate
        assert training.schedule.warmup_steps == expected.warmup_steps
        assert training.schedule.total_steps == expected.steps
    assert compose_train(f"scale={scale}").stage == "stage1"


@pytest.mark.parametrize(
    "path",
    sorted(CONF.rglob("*.yaml")) + sorted(SWEEPS.glob("*.yaml")),
    ids=lambda path: path.stem,
)
def test_files_with_keys_of_their_own_name_self_among_the_defaults(path):
    keys = set(OmegaConf.load(path))
    if "defaults" in keys and len(keys) > 1:
        assert "_self_" in OmegaConf.load(path).defaults


def test_every_table_has_its_sweep():
    assert {path.stem for path in SWEEPS.glob("*.yaml")} == {t.key for t in find_tables("all")}
