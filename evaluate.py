"""Measure a model or a file of Gaussians, before and after the paper's post-optimization.

python evaluate.py run=last
"""

import warnings
from collections.abc import Mapping
from pathlib import Path

from asysplat.overrides import exit_at_unknown_overrides

if __name__ == "__main__":
    exit_at_unknown_overrides("evaluate")

import hydra
import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import nn

from asysplat.data import SceneDataModule
from asysplat.errors import InputError
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.post_optimization import HOW, PostOptimization, Predict
from asysplat.evaluation.rows import write_csv
from asysplat.evaluation.scenes import image_rows, measure_scenes, set_results
from asysplat.export import read_gaussians
from asysplat.interrupts import handle_signals
from asysplat.models.early_exit import EXACT
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views
from asysplat.training.checkpoints import load_weights
from asysplat.training.evaluation_target import find_target
from asysplat.training.messages import exit_with_message, quiet_lightning
from asysplat.training.runs import EVALUATION
from asysplat.training.summary import print_evaluation, write_json


@hydra.main(config_path="conf", config_name="evaluate", version_base="1.3")
def main(options: DictConfig) -> None:
    with exit_with_message("stopped; the same command resumes with the scenes that are missing."):
        evaluate(options)


def evaluate(options: DictConfig) -> None:
    """Measure every scene that was not measured yet; write and print the results of all."""
    quiet_lightning()
    target = find_target(options, HydraConfig.get().overrides.task)
    config = target.config
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    try:  # the device and the precision of a prediction, as in the test of train.py
        choices = {key: config.trainer[key] for key in ("accelerator", "precision")}
        fabric = lightning.Fabric(devices=1, **choices)
    except (ValueError, MisconfigurationException) as error:
        raise InputError(f"trainer: {error}") from error
    measure = make_measure(config, options, fabric.device)
    data = instantiate(config.data)
    data.setup()
    data.check_sizes(measure.protocol.check_size)
    if options.scene is None:
        (predict, early_exit), tests = open_network(config, data, fabric), data.tests
    else:
        predict, early_exit = open_gaussians(options.scene, data, fabric.device), {}
        tests = {data.name: data.tests[data.name]}

    folders = target.folder, target.scene_folder
    scenes = measure_scenes(tests, predict, measure, fabric.device, *folders, early_exit)

    if options.run is None:  # a run has one
        OmegaConf.save(options, target.folder / "config.yaml", resolve=True)
    results = target.described | {"evaluation/post_optimization": HOW}
    results |= {f"protocol/{k}": v for k, v in measure.protocol.sentences().items()}
    results |= set_results(scenes, measure.protocol.mean_over)
    write_csv(target.folder / "evaluation.csv", image_rows(scenes))
    write_json(target.folder / EVALUATION, results)
    print_evaluation(results, list(scenes), target.folder)


def make_measure(config: DictConfig, options: DictConfig, device: torch.device) -> PostOptimization:
    """Build what measures a scene; without LPIPS, and a warning, if its backbone is missing."""
    protocol = instantiate(config.metrics)
    lpips = load_lpips(protocol.lpips_net, Path(options.paths.weights), options.paths.download)
    if lpips is None:
        warnings.warn(protocol.without_lpips(), stacklevel=1)
    else:
        lpips.to(device)
    steps = tuple(options.steps) if isinstance(options.steps, ListConfig) else (options.steps,)
    color = config.training.background
    background = None if color == "inputs" else torch.tensor(color, device=device)
    return PostOptimization(steps, protocol, lpips, background)


def open_network(
    config: DictConfig, data: SceneDataModule, fabric: lightning.Fabric
) -> tuple[Predict, Mapping[str, float]]:
    """Load a model; return its prediction of a scene, and what its last early exit left out."""
    net = instantiate(config.model)
    data.check_sizes(net.check_size)
    load_weights(config.init_path, nn.ModuleDict({"net": net}))  # named as in a checkpoint
    net.to(fabric.device).eval()
    net.early_exit = instantiate(config.get("speed")) or EXACT  # absent in the oldest runs
    net.check_early_exit(net.early_exit)
    print(f"model: {net.describe()}")

    def predict(inputs: Views) -> Gaussians:
        with torch.no_grad(), fabric.autocast():
            return net(Views.stack([inputs])).map(lambda tensor: tensor[0].float())

    return predict, net.early_exit_shares


def open_gaussians(path: str, data: SceneDataModule, device: torch.device) -> Predict:
    """Read the Gaussians of the data's one scene, of which its input views must show some."""
    scenes = data.tests[data.name]
    if len(scenes) != 1:
        raise InputError(
            f"scene={path} is one scene, and the data has {len(scenes)} to test: name the folder "
            "of that scene as data.root."
        )
    sample = scenes[0]
    scene = getattr(scenes.tasks[0].sequence, "scene", None)  # of files
    gaussians = read_gaussians(path, scene and scene.origin)
    gaussians = sample["frame"].to_network(gaussians).to(device)
    if not render(gaussians, sample["inputs"].cameras.to(device), depth=False).alpha.any():
        raise InputError(
            f"scene={path} has {gaussians.num_gaussians} Gaussians, and none is visible in the "
            f"input views of {sample['scene']}: name the file of that scene, in the world and the "
            "units of its cameras."
        )
    return lambda inputs: gaussians


if __name__ == "__main__":
    handle_signals()
    main()
