"""Every file under conf/ composes, builds its model, trains a step, and starts with its
command."""

import importlib.util
import math
import re
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tiny import SCENES, SIZE, VIEWS

from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.errors import InputError
from asysplat.refinement import BRIEF, DEFAULT, FEW, PAPER, PUBLISHED_3DGS, SCAFFOLD_GS
from asysplat.runs.stages import check_stages
from paper.tables import find_tables

ROOT = Path(__file__).parents[2]
CONF, SWEEPS = ROOT / "conf", ROOT / "conf" / "sweeps"
FILES = sorted(CONF.rglob("*.yaml"))
# Parts that several files share.
PARTS = {"model=asysplat", "model=blocks", "model=one_branch", "data=views", "data=disk"}
CHOICES = {
    f"{path.parent.relative_to(CONF)}={path.stem}"
    for path in CONF.rglob("*.yaml")
    if path.parent
    not in (CONF, *(CONF / each for each in ("refinement", "quality", "public")), SWEEPS)
}
CHOICES = sorted(CHOICES - PARTS)
STAGES = ("stage1", "stage2", "stage3", "ablation")
UNTRAINED = "model=plane_sweep"
TRAINED = [choice for choice in CHOICES if choice.startswith(("model=", "experiment=t"))]
TRAINED.remove(UNTRAINED)
TRAINED += ["stage=stage3", "stage=ablation"]
# Models that differ from another in the mix of their layers alone, and what takes long.
MIX = r"model=(asysplat_\d[mt]\d?a?|asysplat_7m1[st]|longlrm_(18|24))$|experiment=three_stages"
TRAINED = [
    pytest.param(choice, marks=[pytest.mark.slow] if re.match(MIX, choice) else [])
    for choice in TRAINED
]
TINY = [*SIZE, *VIEWS, *SCENES, "data.test_sets=null", "data.batch_size=1"]


@pytest.fixture(scope="session")
def composed(composed):
    return partial(composed, return_hydra_config=True)


@pytest.mark.medium
@pytest.mark.parametrize("choice", CHOICES)
def test_a_choice_composes_and_builds_its_model(build, choice):
    count = sum(p.numel() for p in build(choice, device="meta").parameters())
    assert count == 0 if choice == UNTRAINED else count > 1e6


def test_a_model_without_parameters_is_not_trained(composed):
    with pytest.raises(InputError, match="nothing to train"):
        check_stages([composed(UNTRAINED)])


def test_hydra_and_the_code_read_the_same_refinements(composed):
    names = {path.stem for path in (CONF / "refinement").glob("*.yaml")}
    coded = {"default": DEFAULT, "few": FEW, "paper": PAPER, "3dgs": PUBLISHED_3DGS}
    coded |= {"scaffold_gs": SCAFFOLD_GS, "brief": BRIEF}
    assert names == coded.keys()
    for name, expected in coded.items():
        config = composed(f"refinement={name}", script="reconstruct")
        assert instantiate(config.refinement) == expected, name


def test_qualities_raise_everything_together(composed):
    names = ("preview", "good", "best")
    configs = [composed(f"quality={name}", script="reconstruct") for name in names]
    for key in ("height", "views", "seconds", "refinement.max_gaussians"):
        values = [OmegaConf.select(config, key) or math.inf for config in configs]
        assert values == sorted(set(values)), key


def test_a_gpu_takes_more_unless_something_is_chosen(composed, capsys):
    spec = importlib.util.spec_from_file_location("script", ROOT / "reconstruct.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    config, gpu = (composed(f"quality={name}", script="reconstruct") for name in ("good", "gpu"))
    cuda = torch.device("cuda")
    taken = script.for_device(config, cuda, set())
    for name in ("height", "seconds", "refinement"):
        assert taken[name] == gpu[name] != config[name]
    assert "quality=gpu; to avoid it, quality=good" in capsys.readouterr().out
    given = {"height", "refinement.sh_degree"}
    kept = script.for_device(config, cuda, given)
    assert (kept.height, kept.refinement.sh_degree) == (256, 2)
    assert (kept.seconds, kept.refinement.max_gaussians) == (30, 1_000_000)
    for given in ({"quality"}, {"refinement"}):
        assert script.for_device(config, cuda, given) is config
    assert script.for_device(config, torch.device("cpu"), set()) is config
    config.run = "last"
    assert script.for_device(config, cuda, set()) is config


@pytest.mark.medium
@pytest.mark.parametrize("sweep", sorted(path.stem for path in SWEEPS.glob("*.yaml")))
def test_every_row_of_a_sweep_builds_its_model(composed, build, sweep):
    config = composed(f"sweeps={sweep}")
    assert config.hydra.mode.name == "MULTIRUN"
    assert config.name == sweep
    varied = {key: values for key, values in config.hydra.sweeper.params.items() if key != "seed"}
    assert varied
    for key, values in varied.items():
        for value in values.split(","):
            build(f"sweeps={sweep}", f"{key}={value}", device="meta")


@pytest.mark.medium
@pytest.mark.parametrize("choice", TRAINED)
def test_a_choice_trains_a_step_at_a_tiny_size(composed, choice):
    config = composed(choice, *TINY)
    data = instantiate(config.data)
    module = instantiate(config.training, net=instantiate(config.model))
    batch = collate([TrainingTasks(data)[0]])
    optimizer = module.configure_optimizers()["optimizer"]
    weights = {n: p for n, p in module.net.named_parameters() if n.startswith(("head", "gaussian"))}
    before = {name: parameter.detach().clone() for name, parameter in weights.items()}
    prediction = module(batch, depth=module.loss.needs_depth)
    loss = module.loss(prediction, batch)["loss"]
    loss.backward()
    optimizer.step()
    assert loss.isfinite()
    # Otherwise processes that train together would wait for the gradient.
    assert all(p.grad is not None for p in module.parameters() if p.requires_grad)
    assert weights
    for name, parameter in weights.items():
        assert not torch.equal(before[name], parameter) and parameter.isfinite().all(), name


def test_files_with_keys_of_their_own_name_self_among_the_defaults():
    for path in FILES:
        content = OmegaConf.load(path)
        if "defaults" in content and len(content) > 1:
            assert "_self_" in content.defaults, path


@pytest.mark.parametrize("scale", ["laptop", "gpu", "paper"])
def test_a_stage_sets_the_sizes_of_its_scale(composed, scale):
    for stage in STAGES:
        config = composed(f"scale={scale}", f"stage={stage}")
        assert set(config.stages) == set(STAGES)
        expected = config.stages[stage]
        data, training = config.data, config.training
        assert (data.height, data.width) == (expected.height, expected.width)
        assert (data.batch_size, config.steps) == (expected.batch_size, expected.steps)
        assert training.optimizer.lr == config.learning_rate == expected.learning_rate
        assert training.schedule.warmup_steps == expected.warmup_steps
        assert training.schedule.total_steps == expected.steps
    assert composed(f"scale={scale}").stage == "stage1"


def test_every_table_has_its_sweep():
    tables = Counter(table.key for table in find_tables("all") if table.rows)
    assert tables == Counter(path.stem for path in SWEEPS.glob("*.yaml"))


def test_every_option_of_train_is_read(composed):
    """By another file of conf/ or by code; what is instantiated refuses unknown keys itself."""
    settings = "\n".join(path.read_text() for path in FILES)
    code = "\n".join(
        path.read_text() for path in (*ROOT.glob("*.py"), *ROOT.glob("asysplat/**/*.py"))
    )
    groups = {path.name for path in CONF.iterdir() if path.is_dir()} | {"defaults", "hydra"}
    options = set(OmegaConf.load(CONF / "train.yaml")) - groups
    for stage in composed().stages.values():
        options |= set(stage)
    unread = [
        key
        for key in options
        if not re.search(rf"\$\{{.*\b{key}\b", settings)
        and not re.search(rf"\b(config|options|stage)\.{key}\b|[\"']{key}[\"']", code)
    ]
    assert options and unread == []
