"""Names in the files of runs that an earlier version of the code wrote, and today's names.

Whoever renames a class of conf/, a configuration key or a key of metrics.json adds a line here.
"""

import re
from collections.abc import Mapping
from typing import Any

FORMAT = 5  # version of the files of a run; raise it with every line that is added below

CLASSES = {
    "asysplat.models.CoarseSource": "asysplat.models.CoarseTokens",
    "asysplat.models.FineSource": "asysplat.models.FineTokens",
    "asysplat.models.MergedSource": "asysplat.models.FusedTokens",
    "asysplat.models.CoarseReadsFine": "asysplat.models.FineToCoarse",
    "asysplat.models.FineReadsCoarse": "asysplat.models.CoarseToFine",
    "asysplat.models.PhotographHead": "asysplat.models.ResidualHead",
    "asysplat.models.SceneSkips": "asysplat.models.EarlyExit",
    "asysplat.models.SweepPrior": "asysplat.models.PlaneSweepPrior",
    "asysplat.reconstruction.Rates": "asysplat.refinement.Rates",
    "asysplat.reconstruction.Settings": "asysplat.refinement.RefinementSettings",
    "asysplat.training.Reconstruction": "asysplat.training.SplattingModule",
    "asysplat.training.ReconstructionLoss": "asysplat.training.SplattingLoss",
    "asysplat.training.tensorboard.make_logger": "asysplat.training.tensorboard.TensorBoard",
    "asysplat.training.perceptual.longlrm": "asysplat.training.losses.perceptual.longlrm",
    "asysplat.training.perceptual.vgg16": "asysplat.training.losses.perceptual.vgg16",
    "lightning.pytorch.loggers.TensorBoardLogger": "asysplat.training.tensorboard.TensorBoard",
    "asysplat.training.loggers.make_wandb_logger": "lightning.pytorch.loggers.WandbLogger",
    "asysplat.training.callbacks.Pictures": "asysplat.training.callbacks.Figures",
    "asysplat.training.callbacks.Progress": "asysplat.training.callbacks.TrainingProgressBar",
    "asysplat.training.callbacks.SkipNonFiniteSteps": "asysplat.training.callbacks.NonFiniteSteps",
    "asysplat.training.callbacks.SkippedScenes": "asysplat.training.callbacks.BadScenes",
    "asysplat.training.callbacks.Watch": "asysplat.training.callbacks.TrainingMonitor",
}
KEYS = {  # keys of the configuration; a new name has the same parent
    "callbacks.guard": "non_finite_steps",
    "callbacks.pictures": "figures",
    "callbacks.skips": "bad_scenes",
    "callbacks.watch": "monitor",
    "data.num_frames": "num_images",
    "data.on_bad_frame": "on_bad_image",
    "model.coarse_reads_fine": "fine_to_coarse",
    "model.fine_reads_coarse": "coarse_to_fine",
    "model.prior.neighbours": "neighbors",
    "model.source": "fusion",
    "speed.known": "skip_network_above",
    "speed.sure": "skip_layers_above",
}
ANY = object()
REMOVED = {  # with the value that had no effect
    "callbacks.early_exit": ANY,  # its numbers are results of Metrics
    "callbacks.guard.folder": ANY,
    "callbacks.skipped": ANY,
    "speed.coverage": None,
    "speed.faint": None,
}
RESULTS = {  # parts of the keys of metrics.json, as regular expressions
    r"^evaluation/scenes$": "evaluation/gaussians",
    r"^evaluation/steps$": "evaluation/post_optimization_steps",
    r"/geometry_share$": "/geometry_ratio",
    r"/mean_colour/": "/mean_color/",
    r"^mean_colour/": "mean_color/",
    r"^skip/(.+)/views$": r"early_exit/\1/network",
    r"^skip/": "early_exit/",
    r"/post_optimisation$": "/post_optimization",
    r"^skipped$": "count",  # in the state of BadScenes and NonFiniteSteps
    r"^troubles$": "errors",  # in the state of BadScenes
}
CALLBACKS = {old.rpartition(".")[2]: new.rpartition(".")[2] for old, new in CLASSES.items()}


def upgrade_config(config: Mapping[Any, Any], prefix: str = "") -> dict[Any, Any]:
    """Return a resolved configuration under today's names; `prefix`: its path within the whole."""
    upgraded = {}
    for key, value in config.items():
        path = f"{prefix}{key}"
        if path in REMOVED and REMOVED[path] in (ANY, value):
            continue
        if isinstance(value, Mapping):
            value = upgrade_config(value, f"{path}.")
        elif key == "_target_":
            value = CLASSES.get(str(value), value)
        upgraded[KEYS.get(path, key)] = value
    return upgraded


def upgrade_checkpoint(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a checkpoint under today's names; its weights are as they were."""
    upgraded = dict(checkpoint)
    if "hyper_parameters" in upgraded:
        upgraded["hyper_parameters"] = upgrade_config(upgraded["hyper_parameters"])
    if "callbacks" in upgraded:
        states = upgraded["callbacks"].items()
        upgraded["callbacks"] = {
            CALLBACKS.get(key, key): upgrade_results(state) for key, state in states
        }
    return upgraded


def upgrade_results(results: Any) -> Any:
    """Return the content of metrics.json or evaluation.json, or a part of it, under today's names.

    So are the states of callbacks, which have some of the keys.
    """
    if isinstance(results, list):
        return [upgrade_results(value) for value in results]
    if not isinstance(results, Mapping):
        return results
    upgraded = {}
    for key, value in results.items():
        for old, new in RESULTS.items() if isinstance(key, str) else ():
            key = re.sub(old, new, key)
        upgraded[key] = upgrade_results(value)
    return upgraded
