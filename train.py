"""Fit, then test, one configuration.

python train.py model=asysplat_4m4s scale=laptop
"""

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

import hydra
import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from asysplat.errors import InputError
from asysplat.interrupts import keep_interrupts
from asysplat.overrides import exit_at_unknown_overrides
from asysplat.training.callbacks.checkpoints import AtomicCheckpointIO
from asysplat.training.checkpoints import (
    check_checkpoint,
    config_diff,
    find_checkpoint,
    has_checkpoints,
    load_weights,
    read_notes,
)
from asysplat.training.failures import sentence_of
from asysplat.training.quiet import quiet_lightning
from asysplat.training.revision import revision
from asysplat.training.run_folder import locked, run_folder
from asysplat.training.runs import RESULTS, Run, describe_run, find_run
from asysplat.training.stages import (
    StageRecord,
    check_stages,
    describe_stage,
    results_of_stage,
    resume_point,
    stage_configs,
)
from asysplat.training.summary import Results, print_summary, write_json
from asysplat.training.tensorboard import cut_events, log_choices, log_outcome


@hydra.main(config_path="conf", config_name="train", version_base="1.3")
def main(config: DictConfig) -> float | None:
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return train_in_sweep(config)
    try:
        return train(config)
    except KeyboardInterrupt:
        sys.exit("stopped.")  # before training or after the test; in between, Checkpoints prints it
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is None:
            raise
        sys.exit(f"error: {sentence}")


def train_in_sweep(config: DictConfig) -> float | None:
    """Train one job of a sweep, unless a finished run has its results.

    With `rerun`, only a run of this revision of the code counts. A failure is printed at once, the
    other jobs go on, and Hydra reports it again at the end of the sweep.
    """
    job = HydraConfig.get().job
    try:
        finished = find_run(Path(config.paths.logs), config)
        if finished is None or (config.rerun and finished.revision != revision()):
            print(f"job {job.num}: {job.override_dirname}", flush=True)
            return train(config)
        print(f"job {job.num}: {finished_text(finished)}", flush=True)
        return finished.results.get(f"test/{config.data.name}/psnr")
    except Exception as error:
        known = sentence_of(error)
        if known is None:
            traceback.print_exc()
        sentence = f"failed: job {job.num}: {job.override_dirname}: {known or repr(error)}"
        print(sentence, file=sys.stderr, flush=True)
        raise CompactHydraException(sentence) from None


def finished_text(run: Run) -> str:
    """Write what a sweep prints about a run that it does not repeat."""
    other = f" by {run.revision}, while this is {revision()}; to run it again: rerun=true"
    return f"finished already{other if run.revision != revision() else ''}\nrun: {run.folder}"


def train(config: DictConfig) -> float | None:
    """Train and test, stage by stage; return the test PSNR, which a sweep may optimize."""
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    stages = stage_configs(config)
    check_stages(stages)
    with locked(Path(config.paths.run)):
        return train_stages(config, stages)


def train_stages(config: DictConfig, stages: Sequence[DictConfig]) -> float | None:
    """Train and test the stages of a run, from a checkpoint if there is one to go on from."""
    quiet_lightning()
    folder = Path(config.paths.run)
    described = describe_run(config)  # now, since files may be edited while this trains
    checkpoint = find_checkpoint(config.ckpt_path, folder, Path(config.paths.logs) / config.name)
    first, earlier = resume_point(checkpoint, stages)
    weights = config.init_path if checkpoint is None else None
    for stage in stages[first:-1]:
        stage.paths.run = str(folder / stage.stage)
        found = train_stage(stage, weights, checkpoint, earlier)
        if rank_zero_only.rank == 0:
            print_summary(earlier | found, config.data.name, Path(stage.paths.run))
        earlier = earlier | results_of_stage(stage.stage, found)
        weights, checkpoint = f"{stage.paths.run}/checkpoints/last.ckpt", None
    results = described | earlier | train_stage(config, weights, checkpoint, earlier)
    if rank_zero_only.rank == 0:
        write_json(folder / RESULTS, results)
        print_summary(results, config.data.name, folder)
    return results.get(f"test/{config.data.name}/psnr")


def train_stage(
    config: DictConfig, weights: str | None, checkpoint: Path | None, earlier: Results
) -> Results:
    """Train and test one stage; return what was measured.

    Args:
        config: of the stage.
        weights: to start from, as `init_path` names them.
        checkpoint: to resume from.
        earlier: results of the stages before it.
    """
    folder = Path(config.paths.run)
    folder.mkdir(parents=True, exist_ok=True)
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    data = instantiate(config.data)
    data.setup()
    net = instantiate(config.model)
    skips = instantiate(config.speed)
    net.check_early_exit(skips)
    data.check_sizes(net.check_size)
    data.check_sizes(instantiate(config.metrics).check_size)
    module = instantiate(config.training, net=net)
    check_checkpoint(checkpoint, module)
    load_weights(weights, module)
    print(f"{config.stage}: {describe_stage(config)}")
    print(f"model: {net.describe()}")

    OmegaConf.save(config, folder / "config.yaml", resolve=True)
    options = OmegaConf.to_container(config, resolve=True)
    module.save_hyperparameters(options, logger=False)
    made = instantiate(config.get("callbacks") or {})
    callbacks = {name: callback for name, callback in made.items() if callback is not None}
    notes = {} if checkpoint is None else read_notes(checkpoint)
    for difference in config_diff(notes, options, revision()):
        print(f"not as before: {difference}")
    goes_on = has_checkpoints(folder)
    cut_events(folder, notes["event_files"] if goes_on else {})
    logger = instantiate(config.logger)
    if logger is not None and not goes_on:
        log_choices(logger, config)
    trainer = make_trainer(config, callbacks, StageRecord(config.stage, earlier), logger)
    split = data.split(trainer.world_size)
    trainer.accumulate_grad_batches = split.accumulated
    if trainer.is_global_zero:
        print(split)
    trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
    net.early_exit = skips
    trainer.test(module, data, verbose=False)

    results = {}
    if "costs" in callbacks:
        results |= callbacks["costs"].values
    for name in ("metrics", "early_exit"):
        if name in callbacks:
            results |= callbacks[name].results
    if trainer.is_global_zero and logger is not None:
        log_outcome(logger, results, data.name)
    return results


def make_trainer(
    config: DictConfig,
    callbacks: dict[str, lightning.Callback],
    record: StageRecord,
    logger: Logger | None,
) -> lightning.Trainer:
    """Build Lightning's trainer.

    Raises:
        InputError: it refuses an option, or a device does not exist.
    """
    try:
        return instantiate(
            config.trainer,
            callbacks=[*callbacks.values(), record],
            logger=logger or False,
            # Otherwise Lightning adds its own in place of those that are left out.
            enable_checkpointing="checkpoints" in callbacks,
            plugins=[AtomicCheckpointIO()],
            enable_progress_bar="progress" in callbacks,
        )
    except InstantiationException as error:
        raise InputError(f"trainer: {error.__cause__}") from error


if __name__ == "__main__":
    keep_interrupts()
    os.environ.setdefault("ASYSPLAT_SHARED", str(Path(__file__).parents[1] / "shared"))
    exit_at_unknown_overrides("train")
    OmegaConf.register_new_resolver("run_folder", run_folder, replace=True, use_cache=True)
    main()
