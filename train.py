"""Train and test a model.

python train.py model=asysplat_4m4s scale=laptop
"""

import sys
import traceback
from pathlib import Path

from asysplat.cli import check_command, command, error_message, exit_with_message

if __name__ == "__main__":
    check_command("train")

import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from asysplat.files import check_writable
from asysplat.runs.machine import revision
from asysplat.runs.runs import find_run
from asysplat.training.prepare import (
    PreparedRun,
    TrainingStage,
    drop_missing_perceptual_term,
    instantiate_option,
    prepare_run,
)
from asysplat.training.run_folder import job_name, run_folder, unused_removed


@command("train")  # during the training, Checkpoints prints how to resume
def main(config: DictConfig) -> float | None:
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return train_in_sweep(config)
    with unused_removed(Path(config.paths.run)):
        return train(config)


def train(config: DictConfig) -> float | None:
    """Train and test the stages of a run; return the test PSNR, which a sweep may optimize."""
    with prepare_run(config) as run:
        for stage in run.stages:
            train_stage(run, stage)
    return run.results.get(f"test/{config.data.name}/psnr")


def train_stage(run: PreparedRun, stage: TrainingStage) -> None:
    config = stage.config
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    data = instantiate(config.data)
    data.setup()
    net = instantiate(config.model)
    module = instantiate(config.training, net=net)
    stage.check(data, net)
    stage.load(module)
    logger = instantiate_option(config, "logger")
    callbacks = instantiate(config.get("callbacks") or {})
    callbacks = {name: callback for name, callback in callbacks.items() if callback is not None}
    options = stage.trainer_options(callbacks, logger)
    trainer = instantiate_option(config, "trainer", **options)
    stage.begin(trainer, data)
    with stage.resuming(trainer):
        trainer.fit(module, data, ckpt_path=stage.checkpoint, weights_only=True)
    trainer.test(module, data, verbose=False)
    run.record(stage, trainer, callbacks)


def train_in_sweep(config: DictConfig) -> float | None:
    """Train one job of a sweep, unless a finished run has its results.

    With `rerun`, only a run of this revision of the code counts. A failure is printed at once, the
    other jobs go on, and Hydra reports it again at the end of the sweep.
    """
    job = HydraConfig.get().job
    try:
        # Before the finished run of what is left is looked for.
        drop_missing_perceptual_term(config)
        finished = find_run(Path(config.paths.logs), config)
        if finished is None or (config.rerun and finished.revision != revision()):
            print(f"job {job.num}: {job.override_dirname}", flush=True)
            return train(config)
        note = ""
        if finished.revision != revision():
            note = f" by {finished.revision}, while this is {revision()}; again with rerun=true"
        print(f"job {job.num}: finished already{note}\nrun: {finished.folder}", flush=True)
        return finished.results.get(f"test/{config.data.name}/psnr")
    except Exception as error:
        reason = error_message(error)
        if reason is None:
            traceback.print_exc()
        message = f"failed: job {job.num}: {job.override_dirname}: {reason or repr(error)}"
        print(message, file=sys.stderr, flush=True)
        raise CompactHydraException(message) from None


def find_logs(overrides: list[str]) -> Path:
    """Return paths.logs of a command, whose folder Hydra writes to before `main`."""
    folders = (
        word.partition("=")[2] for word in reversed(overrides) if word.startswith("paths.logs=")
    )
    return Path(next(folders, "logs"))


if __name__ == "__main__":
    with exit_with_message("stopped."):
        check_writable(find_logs(sys.argv), "paths.logs")
    folder_or_exit = exit_with_message("stopped.")(run_folder)  # Hydra would print a traceback
    OmegaConf.register_new_resolver("run_folder", folder_or_exit, replace=True, use_cache=True)
    OmegaConf.register_new_resolver("job_name", job_name, replace=True)
    main()  # SweepTable ends a sweep with how to resume
