"""The configuration of every sweep on the paper's data, against the paper's protocol."""

from functools import partial
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from asysplat.data.loader import split_batch
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.runs.run_config import flat_options
from asysplat.runs.runs import hashed_options
from paper.tables import load_paper

ROOT = Path(__file__).parents[2]
PLACES = ["data.root=train", "data.test_root=test"]

# Suppl. A, "Evaluation settings": k-means everywhere, the first 96 frames in the ablations, both on
# DL3DV; Sec. 4.1: which sets are tested. LongLRM's protocol, but for Table 5, where pixelSplat's
# line of work is compared with. Tables 2 and 3 are of the same models, and so are those of the
# ablations: each model is tested once on the sets of all of them.
ZERO_SHOT = {"tanks_and_temples", "mipnerf360", "deep_blending", "replica"}
DEPTHS = {"mipnerf360", "scannetpp"}
PAPER = {
    "training_overhead": ("longlrm", "kmeans", set()),
    "state_of_the_art": ("longlrm", "kmeans", ZERO_SHOT),
    "replica": ("longlrm", "kmeans", ZERO_SHOT),
    "inference_overhead": ("longlrm", "kmeans", set()),
    "two_views": ("pixelsplat", "kmeans", set()),
    "architecture": ("longlrm", "first_96", DEPTHS),
    "layers": ("longlrm", "first_96", DEPTHS),
    "asymmetry": ("longlrm", "first_96", DEPTHS),
    "matched_parameters": ("longlrm", "first_96", DEPTHS),
    "more_views": ("longlrm", "kmeans", {"more_views"}),
    "mamba_ratio": ("longlrm", "first_96", DEPTHS),
    "geometry_ratio": ("longlrm", "first_96", DEPTHS),
}
HOW = {
    "tanks_and_temples": ("colmap", "kmeans"),
    "mipnerf360": ("colmap", "kmeans"),
    "deep_blending": ("colmap", "kmeans"),
    "replica": ("replica", "kmeans"),
    "scannetpp": ("scannetpp_depths", "kmeans"),
}


@pytest.fixture(scope="session")
def compose_train(composed):
    return partial(composed, return_hydra_config=True)


def test_every_table_is_listed():
    assert set(PAPER) == set(load_paper())


@pytest.mark.medium
@pytest.mark.parametrize("sweep", PAPER)
def test_every_row_on_dl3dv(compose_train, sweep):
    metrics, selection, test_sets = PAPER[sweep]
    heads = []
    for row in load_paper()[sweep].rows:
        if row.quoted:
            continue
        config = compose_train(f"sweeps={sweep}", "scale=paper", "data=dl3dv", *PLACES, *row.run)
        if row.name != "MVSplat":  # whose head is that of its volume
            heads.append(config.model.head)
        assert config.metrics.name == metrics
        assert config.data.selection == selection
        assert config.data.inputs == (2 if sweep == "two_views" else 32)
        assert set(config.data.test_sets) == test_sets
        for name in test_sets - {"more_views"}:
            how = config.data.test_sets[name]
            assert (how.layout, how.selection, how.root) == (*HOW[name], None)
    assert heads == heads[:1] * len(heads)
    if "replica" in test_sets:
        how = config.data.test_sets.replica
        assert [how.height, how.width] == list(load_paper()["replica"].rows[0].size)
    if "more_views" in test_sets:
        assert config.data.test_sets.more_views.inputs == 64


@pytest.mark.parametrize("sweep", PAPER)
def test_every_set_that_a_table_prints_is_tested(sweep):
    _, _, test_sets = PAPER[sweep]
    first, *others = load_paper()[sweep].test_sets or [None]
    assert set(others) <= test_sets
    assert first in {None, "dl3dv", "realestate10k"} | test_sets


COMMANDS = [
    "",
    "geometry_ratio=0.5",
    "geometry_ratio=0.9 scale=gpu",
    "scale=paper data=dl3dv",
    "data=dl3dv",
    "experiment=ablation",
    "experiment=three_stages",
    "experiment=three_stages scale=paper data=dl3dv",
    "experiment=two_views data=realestate10k",
    *(f"experiment=geometry_{ratio} scale=paper data=dl3dv" for ratio in (50, 60, 70, 80)),
    *(f"sweeps={sweep} scale=paper data=dl3dv" for sweep in PAPER),
]


@pytest.mark.medium
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_paper_compose_its_network(compose_train, command):
    """Without a model: asysplat_4m4s, with the head of the scale."""
    config = compose_train(*command.split(), *(PLACES if "data=" in command else ()))
    assert config.hydra.runtime.choices.model == "asysplat_4m4s"
    assert config.model.layers == "4m4s"
    large = "scale=gpu" in command or "scale=paper" in command
    head = config.model.head
    assert head._target_.endswith(".LongLRMHead" if large else ".ResidualHead")
    assert head.sh_degree == (3 if large else 0)  # 59 numbers, or 14
    assert (config.model.patch_coarse, config.model.patch_fine) == (16, 8)
    if "scale=paper" in command:
        assert config.model.head.farthest == 500 and not config.training.loss.allow_missing
        assert (config.training.loss.perceptual, config.training.loss.depth) == (0.5, 0.01)
        assert config.training.loss.ssim == config.training.loss.opacity == 0


def test_long_lrm_is_as_published(compose_train):
    """arthurhero/Long-LRM, configs/7m1t_tm.yaml and dl3dv_i540_32input_8target.yaml."""
    options = ["scale=paper", "data=dl3dv", *PLACES, "stage=stage3"]
    config = compose_train(*options, "model=longlrm", "recipe=own")
    loss = config.training.loss
    assert (loss.mse, loss.perceptual, loss.opacity, loss.depth) == (1.0, 1.0, 0.1, 0.01)
    assert loss.depth_term._target_ == "asysplat.training.InputDisparity"
    assert loss.perceptual_term._target_ == "asysplat.training.losses.perceptual.longlrm"
    assert config.training.background == [1, 1, 1] and config.trainer.gradient_clip_val == 10
    assert (config.model.prune.prune_ratio, config.model.prune.random_ratio) == (0.5, 0.1)
    assert config.training.drop_above == 5 and config.data.window is None
    first = compose_train(*options[:-1], "model=longlrm")
    assert first.model.prune.prune_ratio == 0
    assert first.data.window == [65, 129]  # 64 to 128 frames apart


PUBLISHED = {"training.drop_above", "training.loss.opacity", "training.loss.perceptual"}


@pytest.mark.medium
@pytest.mark.parametrize("scale", ["laptop", "paper"])
@pytest.mark.parametrize("sweep", PAPER)
def test_rows_are_trained_alike(compose_train, sweep, scale):
    """They differ in the model; Long-LRM's of Tables 2 to 4 at the paper's scale as published."""
    own = scale == "paper" and sweep in {"state_of_the_art", "replica", "inference_overhead"}
    firsts: dict[str, tuple[dict, bool]] = {}
    for row in load_paper()[sweep].rows:
        if row.quoted:
            continue
        config = compose_train(f"sweeps={sweep}", f"scale={scale}", *row.run)
        keys = [key for key in config if key != "hydra"]
        options = flat_options(hashed_options(OmegaConf.masked_copy(config, keys), ()))
        published = own and "model=longlrm" in row.run
        first, of_first = firsts.setdefault(config.stage, (options, published))  # Table 1: three
        differing = {key for key in first | options if first.get(key) != options.get(key)}
        of_model = ("model.", "geometry_ratio", "parameter_budget")
        differing = {key for key in differing if not key.startswith(of_model)}
        assert differing == (PUBLISHED if published != of_first else set())


def test_table_1_takes_steps_alone(compose_train):
    trainer = compose_train("sweeps=training_overhead", "scale=paper").trainer
    options = ("num_sanity_val_steps", "limit_val_batches", "limit_test_batches")
    assert [trainer[option] for option in options] == [0, 0, 0]


def test_table_5_takes_the_frames_of_an_index(compose_train):
    overrides = ["sweeps=two_views", "scale=paper", "data=realestate10k", *PLACES]
    config = compose_train(*overrides, "data.index=index.json")
    assert (config.metrics.name, config.data.inputs, config.data.targets) == ("pixelsplat", 2, 4)
    assert (config.data.selection, config.data.index) == ("index", "index.json")
    assert (config.stage, config.earlier_stages, config.data.test_size) == ("stage1", [], None)
    assert (config.data.height, config.data.width) == (256, 256)
    # MVSplat's config/dataset/view_sampler_dataset_specific_config/bounded_re10k.yaml.
    assert (config.data.first_window, config.data.window) == ([26, 46], [46, 193])
    assert config.data.growth_steps / config.steps == 150_000 / 300_000
    assert compose_train("data=realestate10k", *PLACES).data.first_window is None
    assert compose_train("data=realestate10k", *PLACES).data.selection == "every_8th"


def test_data_with_test_scenes_needs_their_folder(compose_train):
    config = compose_train("data=dl3dv", "data.root=train", "paths.run=here")
    task = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    assert OmegaConf.missing_keys(task) == {"data.test_root"}


def test_the_options_for_several_nodes(compose_train):
    """The options of docs/tables.md fit together."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    printed = (ROOT / "docs" / "tables.md").read_text().replace("\\\n", "").splitlines()
    line, by_torchrun = (line for line in printed if "trainer.num_nodes" in line)
    launch, _, words = by_torchrun.partition("train.py")
    assert launch.startswith("torchrun --nnodes 2 --nproc-per-node 8 ")
    started = compose_train(*words.split()).trainer
    assert (started.num_nodes, started.devices) == (2, 8)
    config = compose_train("scale=paper", "hydra/launcher=submitit_slurm", *line.split())
    trainer, launcher = config.trainer, config.hydra.launcher
    assert trainer.strategy._target_ == "lightning.pytorch.strategies.DDPStrategy"
    assert trainer.num_nodes == launcher.nodes == 2
    assert trainer.devices == launcher.tasks_per_node == launcher.gpus_per_node == 8
    split = split_batch(config.data.batch_size, config.data.micro_batch, 16)
    assert f"`{split}`" in " ".join(printed)


def test_an_unknown_test_set_is_named():
    check_overrides(["test_sets=[mipnerf360,replica]", "test_sets=[]"])
    with pytest.raises(InputError, match=r"did you mean test_sets/mipnerf360"):
        check_overrides(["test_sets=[replica,mipnerf]"])
