"""Fit, then test, one configuration.

python train.py model=asysplat_4m4s scale=laptop
"""

import os
import sys
import traceback
from pathlib import Path

import hydra
import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf

from asysplat.errors import InputError, input_error_behind
from asysplat.overrides import exit_at_unknown_overrides
from asysplat.training.checkpoints import check_checkpoint, find_checkpoint, load_weights
from asysplat.training.quiet import quiet_lightning
from asysplat.training.ranges import check_ranges
from asysplat.training.revision import revision
from asysplat.training.runs import Run, describe_run, find_run
from asysplat.training.summary import print_summary, write_json
from asysplat.training.tensorboard import log_choices, log_outcome, make_logger


@hydra.main(config_path="conf", config_name="train", version_base="1.3")
def main(config: DictConfig) -> float | None:
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return train_in_sweep(config)
    try:
        return train(config)
    except KeyboardInterrupt:
        sys.exit("stopped.")  # before training or after the test; in between, Checkpoints prints it
    except Exception as error:
        mistake = input_error_behind(error)
        if mistake is None:
            raise
        sys.exit(f"error: {mistake}")


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
        mistake = input_error_behind(error)
        if mistake is None:
            traceback.print_exc()
        sentence = f"failed: job {job.num}: {job.override_dirname}: {mistake or repr(error)}"
        print(sentence, file=sys.stderr, flush=True)
        raise CompactHydraException(sentence) from None


def finished_text(run: Run) -> str:
    """Write what a sweep prints about a run that it does not repeat."""
    other = f" by {run.revision}, while this is {revision()}; to run it again: rerun=true"
    return f"finished already{other if run.revision != revision() else ''}\nrun: {run.folder}"


def train(config: DictConfig) -> float | None:
    """Train and test; return the test PSNR, which a sweep may optimise."""
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    check_ranges(config)
    quiet_lightning()
    folder = Path(config.paths.run)
    described = describe_run(config)  # now, since files may be edited while this trains
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    checkpoint = find_checkpoint(config.ckpt_path, Path(config.paths.logs) / config.name)
    data = instantiate(config.data)
    data.setup()
    net = instantiate(config.model)
    skips = instantiate(config.speed)
    net.check_skips(skips)
    data.check_sizes(net.check_size)
    data.check_sizes(instantiate(config.metrics).check_size)
    module = instantiate(config.training, net=net)
    check_checkpoint(checkpoint, module)
    load_weights(config.init_path, module)
    print(f"model: {net.describe()}")

    OmegaConf.save(config, folder / "config.yaml", resolve=True)
    made = instantiate(config.get("callbacks") or {})
    callbacks = {name: callback for name, callback in made.items() if callback is not None}
    logger = make_logger(folder)
    log_choices(logger, config)
    trainer = make_trainer(config, callbacks, logger)
    trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
    net.skips = skips
    trainer.test(module, data, verbose=False)

    results = described
    if "costs" in callbacks:
        results |= callbacks["costs"].values
    for name in ("metrics", "skipped"):
        if name in callbacks:
            results |= callbacks[name].results
    if trainer.is_global_zero:
        write_json(folder / "metrics.json", results)
        log_outcome(logger, results, data.name)
        print_summary(results, data.name, folder)
    return results.get(f"test/{data.name}/psnr")


def make_trainer(
    config: DictConfig, callbacks: dict[str, lightning.Callback], logger: Logger
) -> lightning.Trainer:
    """Build Lightning's trainer.

    Raises:
        InputError: it refuses an option, or a device does not exist.
    """
    try:
        return instantiate(
            config.trainer,
            callbacks=list(callbacks.values()),
            logger=logger,
            # Otherwise Lightning adds its own in place of those that are left out.
            enable_checkpointing="checkpoints" in callbacks,
            enable_progress_bar="progress" in callbacks,
        )
    except InstantiationException as error:
        raise InputError(f"trainer: {error.__cause__}") from error


if __name__ == "__main__":
    os.environ.setdefault("ASYSPLAT_SHARED", str(Path(__file__).parents[1] / "shared"))
    exit_at_unknown_overrides("train")
    main()
