"""Prepare a run and its stages: checks, folder, resumption, results.

train.py instantiates what the configuration names, fits and tests; the rest of a run is here.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from torch import nn

from asysplat.data.datamodule import SceneDataModule
from asysplat.errors import InputError, brief, input_error_behind
from asysplat.models.network import Network
from asysplat.runs import checkpoints
from asysplat.runs.machine import find_accelerator, revision
from asysplat.runs.run_config import plain_options
from asysplat.runs.runs import RESULTS, describe_run
from asysplat.runs.stages import check_stages, describe_stage, resume_point, stage_configs
from asysplat.runs.summary import Results, print_summary, write_json
from asysplat.training.callbacks.checkpoints import AtomicCheckpointIO, StageRecord
from asysplat.training.loggers import log_choices, log_results, quiet_lightning
from asysplat.training.losses.splatting import report_missing
from asysplat.training.module import SplattingModule
from asysplat.training.run_folder import locked

Callbacks = Mapping[str, lightning.Callback]
_say = rank_zero_only(partial(print, flush=True))  # one process of several speaks


@dataclass
class TrainingStage:
    """A stage of a run."""

    config: DictConfig
    weights: str | None  # weights to start from, as `init_path` names them
    checkpoint: Path | None  # checkpoint to resume from
    earlier: Results  # results of the stages before it

    @property
    def folder(self) -> Path:
        return Path(self.config.paths.run)

    def check(self, data: SceneDataModule, net: Network) -> None:
        """Check that the test sets fit the model and the metrics."""
        data.check_sizes(net.check_size)
        data.check_views(net.check_views)
        data.check_sizes(instantiate(self.config.metrics).check_size)

    def load(self, module: SplattingModule) -> None:
        """Load the weights to start from, and say what is trained."""
        checkpoints.load_weights(self.weights, module)
        _say(f"{self.config.stage}: {describe_stage(self.config)}")
        _say(f"model: {module.net.describe()}")
        options = plain_options(self.config)
        module.save_hyperparameters(options, logger=False)
        metadata = {} if self.checkpoint is None else checkpoints.read_metadata(self.checkpoint)
        for difference in checkpoints.config_diff(metadata, options, revision()):
            _say(f"not as before: {difference}")

    def trainer_options(self, callbacks: Callbacks, logger: Logger | None) -> dict[str, Any]:
        """Return the trainer's arguments that conf/trainer does not have, and its accelerator."""
        return {
            "accelerator": find_accelerator(self.config.trainer.accelerator),
            "callbacks": [*callbacks.values(), StageRecord(self.config.stage, self.earlier)],
            "logger": logger or False,
            # Otherwise Lightning adds its own callbacks.
            "enable_checkpointing": "checkpoints" in callbacks,
            "plugins": [AtomicCheckpointIO()],
            "enable_progress_bar": isinstance(callbacks.get("progress"), ProgressBar),
        }

    def begin(self, trainer: lightning.Trainer, data: SceneDataModule) -> None:
        """Divide the batches between the processes, and write the first file: config.yaml."""
        split = data.split(trainer.world_size)
        trainer.accumulate_grad_batches = split.accumulated
        self.folder.mkdir(parents=True, exist_ok=True)
        if trainer.is_global_zero:
            print(split)
            OmegaConf.save(self.config, self.folder / "config.yaml", resolve=True)
        if trainer.logger is not None:
            log_choices(trainer.logger, self.config)

    @contextmanager
    def resuming(self, trainer: lightning.Trainer) -> Generator[None]:
        """Turn an error while the checkpoint is restored into an InputError that names it."""
        try:
            yield
        except Exception as error:
            known = isinstance(error, OSError | MemoryError | torch.OutOfMemoryError)
            begun = trainer.train_dataloader is not None
            if self.checkpoint is None or begun or known or input_error_behind(error):
                raise
            raise InputError(
                f"ckpt_path={self.checkpoint} cannot be resumed ({brief(error)}): init_path in "
                "place of ckpt_path starts from its weights, with a new optimizer and schedule."
            ) from error


def instantiate_option(config: DictConfig, key: str, **arguments: object) -> Any:
    """Instantiate `config[key]`, an object of a library."""
    try:
        return instantiate(config[key], **arguments)
    except InstantiationException as error:
        raise InputError(f"{key}: {error.__cause__}") from error


@dataclass
class PreparedRun:
    """A run that has its folder to itself."""

    config: DictConfig
    fingerprint: Results  # see `describe_run`
    stages: Sequence[TrainingStage]  # stages that are still to be trained
    results: Results  # results of the stages that are finished

    def record(
        self, stage: TrainingStage, trainer: lightning.Trainer, callbacks: Callbacks
    ) -> None:
        """Collect what a tested stage measured; write metrics.json after the last; print it."""
        new_results = dict(callbacks["costs"].values) if "costs" in callbacks else {}
        new_results |= callbacks["metrics"].results if "metrics" in callbacks else {}
        data, folder, is_last = self.config.data.name, stage.folder, stage is self.stages[-1]
        shown = self.results | new_results
        if is_last:
            losses = {"run/losses": trainer.lightning_module.loss.describe()}
            shown = self.results = self.fingerprint | losses | shown
        else:
            stored = {k: v for k, v in new_results.items() if k.startswith(("test/", "cost/"))}
            self.results |= {f"{stage.config.stage}/{key}": v for key, v in stored.items()}
        if trainer.is_global_zero:
            if trainer.logger is not None:
                log_results(trainer.logger, new_results, data)
            if is_last:
                write_json(folder / RESULTS, shown)
            print_summary(shown, data, folder)


@contextmanager
def prepare_run(config: DictConfig) -> Iterator[PreparedRun]:
    """Check a configuration, lock the run's folder and find the stages that are to be trained."""
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    drop_missing_perceptual_term(config)
    configs = stage_configs(config)
    check_stages(configs)
    find_accelerator(config.trainer.accelerator)  # refuses Apple's GPU before any work starts
    folder = Path(config.paths.run)
    with locked(folder):
        quiet_lightning()
        fingerprint = describe_run(config)  # now, since files may be edited during the training
        runs = Path(config.paths.logs) / config.name
        checkpoint = checkpoints.find_checkpoint(config.ckpt_path, folder, runs, say=_say)
        first, results = resume_point(checkpoint, configs)
        weights = config.init_path if checkpoint is None else None
        file = checkpoint if weights is None else checkpoints.existing_weights(weights)
        if file is not None:  # fits the model, before any scene is made
            with torch.device("meta"):
                net = instantiate(configs[first].model)
            weights_here = nn.ModuleDict({"net": net})  # named as in a checkpoint
            checkpoints.check_checkpoint(file, weights_here)
        stages: list[TrainingStage] = []
        for stage in configs[first:]:
            if stage is not config:
                stage.paths.run = str(folder / stage.stage)
            stages.append(TrainingStage(stage, weights, checkpoint, results))
            weights, checkpoint = f"{stage.paths.run}/checkpoints/last.ckpt", None
        yield PreparedRun(config, fingerprint, stages, results)


def drop_missing_perceptual_term(config: DictConfig) -> None:
    """Set the weight of the perceptual term to 0 if its network is not on this machine."""
    # The run is then hashed and recorded as what it is, a run without the term.
    loss = config.training.loss
    if loss.perceptual:
        try:
            instantiate(loss.perceptual_term)()
        except FileNotFoundError as error:
            reason = f"training.loss.perceptual={loss.perceptual:g}: {error}"
            report_missing(reason, config.allow_missing_losses)
            loss.perceptual = 0.0
