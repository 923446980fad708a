"""The stages of a run: each starts from the weights of the one before."""

from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from asysplat.errors import InputError
from asysplat.ranges import check_training
from asysplat.runs.checkpoints import read_metadata
from asysplat.runs.summary import Results

STAGE_RECORD = "StageRecord"  # the callback in whose state a checkpoint names its stage


def stage_configs(config: DictConfig) -> list[DictConfig]:
    """List the configurations of a run's stages, all tested at the size of the last, its own."""
    names = [*(config.get("earlier_stages") or ()), config.stage]
    size = config.data.test_size or [config.data.height, config.data.width]
    configs = []
    for index, name in enumerate(names):
        if name not in config.stages:
            known = ", ".join(config.stages)
            raise InputError(f"earlier_stages names {name}, which is unknown: choose of {known}.")
        if name in names[:index]:
            raise InputError(
                f"{name} is twice among the stages of the run, {', '.join(names)}: leave it out of "
                "earlier_stages; earlier_stages=[] trains one stage alone."
            )
        earlier = config.copy()
        earlier.stage, earlier.earlier_stages = name, names[:index]
        earlier.data.test_size = size
        configs.append(earlier)
    return [*configs[:-1], config]


def check_stages(stages: Sequence[DictConfig]) -> None:
    """Check the options of every stage, before any scene is made and any step is taken."""
    for stage in stages:
        data = stage.data
        try:
            check_training(stage)
            with torch.device("meta"):
                net = instantiate(stage.model)
            if next(net.parameters(), None) is None:
                raise InputError(
                    "this model has nothing to train: measure it, evaluate.py model=plane_sweep."
                )
            test_size = data.test_size if stage is stages[-1] else None  # that of all stages
            for height, width in filter(None, ((data.height, data.width), test_size)):
                net.check_size(height, width)
                instantiate(stage.metrics).check_size(height, width)
            net.check_views(data.inputs)
        except InputError as error:
            if len(stages) == 1:
                raise
            raise InputError(f"{stage.stage}: {error}") from error
    if len(stages) == 1:
        return
    if (stages[-1].get("callbacks") or {}).get("checkpoints") is None:
        raise InputError(
            "callbacks.checkpoints is left out, and each stage starts from the checkpoint of the "
            "one before: leave it in, or train one stage alone with earlier_stages=[]."
        )


def describe_stage(config: DictConfig) -> str:
    """Write a stage's steps, batch and size as `240 steps of batch 2 at 64x64`."""
    data = config.data
    return f"{config.steps} steps of batch {data.batch_size} at {data.height}x{data.width}"


def resume_point(checkpoint: Path | None, stages: Sequence[DictConfig]) -> tuple[int, Results]:
    """Find where a run resumes: the index of the checkpoint's stage, and the results before it."""
    if checkpoint is None:
        return 0, {}
    names = [stage.stage for stage in stages]
    record = read_metadata(checkpoint)["callbacks"].get(STAGE_RECORD, {})
    stage = record.get("stage", names[0])
    if stage not in names:
        raise InputError(
            f"ckpt_path={checkpoint} is of {stage}, and this run trains {', '.join(names)}: give "
            "the options of its run to resume it, or init_path= instead to start from it."
        )
    return names.index(stage), record.get("earlier", {})
