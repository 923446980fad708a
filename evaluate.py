"""Measure a model or another system, before and after the paper's post-optimization.

python evaluate.py run=last
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from asysplat.cli import check_command, command

if __name__ == "__main__":
    check_command("evaluate")

import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.fabric.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from rich.progress import track
from torch import Tensor, nn

from asysplat.data.datamodule import FixedTasks, Sample, SceneDataModule
from asysplat.data.photographs import normalized_points
from asysplat.errors import InputError
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.metrics import write_csv
from asysplat.evaluation.post_optimization import (
    POST_OPTIMIZATION_METHOD,
    PostOptimization,
)
from asysplat.evaluation.post_optimization import Predict as PredictScene
from asysplat.evaluation.scenes import image_rows, measure_scenes, set_results
from asysplat.evaluation.view_images import (
    ViewImages,
    find_images,
    read_images,
    view_names,
    write_images,
)
from asysplat.export import write_safetensors
from asysplat.export.gaussians import read_notes
from asysplat.export.scene_folder import check_visible, find_files, world_origin
from asysplat.files import check_writable, make_folder
from asysplat.models.network import Network
from asysplat.refinement import (
    AnchorScene,
    RefinementProgress,
    ScaffoldSettings,
    refine,
    refine_scaffold,
)
from asysplat.refinement.init import initial_gaussians
from asysplat.runs.checkpoints import load_weights
from asysplat.runs.evaluation_target import find_target
from asysplat.runs.machine import find_accelerator
from asysplat.runs.runs import EVALUATION
from asysplat.runs.summary import print_evaluation, write_json
from asysplat.scene import Gaussians, Views
from asysplat.training.loggers import quiet_lightning

Predict = Callable[[Sample], PredictScene]  # prediction function for a sample's scene


@dataclass(frozen=True)
class PredictionSource:
    """What is measured.

    Args:
        predict: returns what predicts the scene of a sample from its input views.
        sets: names of the test sets that it is measured on.
        facts: what its results depend on, in addition to the target's fingerprint.
        backgrounds: RGB [3] behind its scenes, by scene; the measure's own for the others.
        costs: what the last prediction cost besides seconds and memory, changed by each.
    """

    predict: Predict
    sets: Sequence[str]
    facts: Mapping[str, float] = field(default_factory=dict)
    backgrounds: Mapping[str, Tensor] = field(default_factory=dict)
    costs: Mapping[str, float] = field(default_factory=dict)


@command("evaluate", "stopped; the same command resumes with the scenes that are missing.")
def evaluate(options: DictConfig) -> None:
    """Measure every scene that was not measured yet; write and print the results of all."""
    quiet_lightning()
    target = find_target(options, HydraConfig.get().overrides.task)
    config = target.config
    check_writable(target.scene_folder, "paths.logs")
    fabric = make_fabric(config)
    measure = make_measure(config, options, fabric.device)
    net = load_network(config, fabric.device) if target.system is None else None
    data = instantiate(config.data)
    data.setup()
    data.check_sizes(measure.protocol.check_size)
    if options.write_images is not None:  # raises where their names are not unique
        for task in data.tests[data.name].tasks:
            view_names(task)
    source = open_source(target.system, options, data, measure, net, fabric)
    measure = replace(measure, backgrounds=source.backgrounds)
    tests = {name: data.tests[name] for name in source.sets}
    # Apart, so that they are measured again once its weights are there
    subfolder = "without_lpips" if measure.lpips is None else ""
    folders = target.folder, target.scene_folder / subfolder
    where = fabric.device, *folders
    scenes = measure_scenes(tests, source.predict, measure, *where, source.costs)
    if options.write_gaussians is not None:
        folder = Path(options.write_gaussians)
        write_predictions(folder, tests[data.name], source.predict, fabric.device)
    if options.write_images is not None:
        folder = Path(options.write_images)
        write_renderings(folder, tests[data.name], source.predict, measure, fabric.device)

    if options.run is None:  # a run has one
        OmegaConf.save(options, target.folder / "config.yaml", resolve=True)
    results = {**target.fingerprint, **source.facts}
    results["evaluation/post_optimization"] = POST_OPTIMIZATION_METHOD
    results |= measure.protocol.notes(measure.lpips)
    results |= set_results(scenes, measure.protocol.mean_over)
    if target.system in ("gaussians", "images"):  # reading a file is no prediction
        left_out = "cost/" if target.system == "images" else "cost/post0/"
        results = {k: v for k, v in results.items() if not k.startswith(left_out)}
    write_csv(target.folder / "evaluation.csv", image_rows(scenes))
    write_json(target.folder / EVALUATION, results)
    print_evaluation(results, list(scenes), target.folder)


def open_source(
    system: str | None,
    options: DictConfig,
    data: SceneDataModule,
    measure: PostOptimization,
    net: Network | None,
    fabric: lightning.Fabric,
) -> PredictionSource:
    """Open what is measured: the network, or the scenes of another system."""
    if net is not None:
        data.check_sizes(net.check_size)
        data.check_views(net.check_views)
        return PredictionSource(network_prediction(net, fabric), list(data.tests))
    tests = data.tests[data.name]
    if system == "gaussians":
        source = open_gaussians(Path(options.gaussians), tests, fabric.device)
    elif system == "images":
        source = PredictionSource(open_images(Path(options.images), tests, fabric.device), ())
    else:
        source = make_refiner(options, measure, tests)
    facts = {"tested/scenes": len(tests), **source.facts}
    return replace(source, sets=[data.name], facts=facts)


def make_fabric(config: DictConfig) -> lightning.Fabric:
    """Return the device and the precision of a prediction, as in the test of train.py."""
    accelerator = find_accelerator(config.trainer.accelerator)
    try:
        precision = config.trainer.precision
        return lightning.Fabric(accelerator=accelerator, devices=1, precision=precision)
    except (ValueError, MisconfigurationException) as error:
        raise InputError(f"trainer: {error}") from error


def make_measure(config: DictConfig, options: DictConfig, device: torch.device) -> PostOptimization:
    """Build what measures a scene; without LPIPS, and a warning, if its backbone is missing."""
    protocol = instantiate(config.metrics)
    lpips = load_lpips(protocol.lpips_net, Path(options.paths.weights), options.paths.download)
    if lpips is None:
        warnings.warn(f"LPIPS is {protocol.without_lpips()}.", stacklevel=1)
    else:
        lpips.to(device)
    steps = options.post_optimization_steps
    steps = tuple(steps) if isinstance(steps, ListConfig) else (steps,)
    per_view = isinstance(instantiate(options.get("refinement")), ScaffoldSettings)
    if (per_view or options.images is not None) and steps != (0,):
        raise InputError(
            f"post_optimization_steps={list(steps)}: images, and Gaussians that depend on the view "
            "as Scaffold-GS's, are measured as they are: add post_optimization_steps=0."
        )
    color, background = config.training.background, None
    if color != "inputs":
        background = torch.tensor(color, dtype=torch.float32, device=device)
    return PostOptimization(steps, protocol, lpips, background)


def load_network(config: DictConfig, device: torch.device) -> Network:
    """Load a model."""
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    net = instantiate(config.model)
    load_weights(config.init_path, nn.ModuleDict({"net": net}))  # named as in a checkpoint
    net.to(device).eval()
    print(f"model: {net.describe()}")
    return net


def network_prediction(net: Network, fabric: lightning.Fabric) -> Predict:
    """Return a network's prediction of a scene, in the precision of the run."""

    def predict(prune: bool, inputs: Views) -> Gaussians:
        with torch.no_grad(), fabric.autocast():
            gaussians = net(Views.stack([inputs]), prune=prune)
        return gaussians.map(lambda tensor: tensor[0].float())

    return lambda sample: partial(predict, sample["prune"])


def open_gaussians(path: Path, tests: FixedTasks, device: torch.device) -> PredictionSource:
    """Read and check the Gaussians of every scene of the data, with the backgrounds of the files.

    The fact tested/residual is the largest of cameras that were fitted (see `SceneFile.read`).
    """
    files = find_files(path, [task.sequence for task in tests.tasks])

    def read(sample: Sample) -> tuple[Gaussians, float | None]:
        gaussians, residual = files[sample["scene"]].read()
        return sample["frame"].to_network(gaussians).to(device, torch.float32), residual

    residuals = []
    for index in track(range(len(tests)), "checking scenes"):
        sample = tests[index]
        gaussians, residual = read(sample)
        cameras = sample["targets"].cameras.to(device)
        check_visible(gaussians, cameras, files[sample["scene"]], residual is not None)
        residuals += [] if residual is None else [residual]
    facts = {}
    if residuals:
        facts["tested/residual"] = max(residuals)
        print(f"{len(residuals)} scenes fitted by cameras, residual {max(residuals):.2%} at most")

    def predict(sample: Sample) -> PredictScene:
        gaussians = read(sample)[0]
        return lambda inputs: gaussians

    colors = {name: read_notes(file.path).background for name, file in files.items()}
    known = {name: torch.tensor(color, device=device) for name, color in colors.items() if color}
    return PredictionSource(predict, (), facts, known)


def open_images(folder: Path, tests: FixedTasks, device: torch.device) -> Predict:
    """Read and check the images of every scene's test views; return what reads a scene's again."""
    paths = find_images(folder, tests.tasks)

    def read(sample: Sample) -> ViewImages:
        size = sample["targets"].images.shape[-2:]
        return read_images(paths[sample["scene"]], *size)

    for index in track(range(len(tests)), "checking scenes"):
        read(tests[index])

    def predict(sample: Sample) -> PredictScene:
        images = ViewImages(read(sample).images.to(device))
        return lambda inputs: images

    return predict


def make_refiner(
    options: DictConfig, measure: PostOptimization, tests: FixedTasks
) -> PredictionSource:
    """Return what refines a scene on its input views, from its sparse points or a plane sweep."""
    costs: dict[str, float] = {}

    def count(progress: RefinementProgress, _: object) -> bool:
        costs["steps"] = float(progress.step)
        return False

    settings = instantiate(options.refinement)
    function = refine_scaffold if isinstance(settings, ScaffoldSettings) else refine
    if options.refinement_steps is None:
        limit = {"seconds": float(options.refinement_seconds)}
    else:
        limit = {"steps": options.refinement_steps}
    sequences = {task.sequence.name: task.sequence for task in tests.tasks}

    def predict(sample: Sample) -> PredictScene:
        points = sequences[sample["scene"]].points
        points = normalized_points(points, sample["frame"])

        def refined(inputs: Views) -> Gaussians | AnchorScene:
            known = None if points is None else points.to(inputs.images.device)
            init = "plane_sweep" if known is None else "points"
            start = initial_gaussians(init, inputs, settings.initial_limit, known)
            of_all = {"background": measure.background, "seed": options.seed, "watch": count}
            return function(start, inputs, settings, **of_all, **limit)

        return refined

    return PredictionSource(predict, (), costs=costs)


def write_predictions(
    folder: Path, tests: FixedTasks, predict: Predict, device: torch.device
) -> None:
    """Write the Gaussians of every test scene, in the data's world, as <scene>.safetensors."""
    make_folder(folder, "write_gaussians")
    for index in track(range(len(tests)), "writing scenes"):
        sample, sequence = tests[index], tests.tasks[index].sequence
        gaussians = predict(sample)(sample["inputs"].to(device)).to(torch.float64)
        path, offset = folder / f"{sample['scene']}.safetensors", world_origin(sequence)
        metadata = {"offset": " ".join(map(repr, offset))}
        # In float64, which comes back from the world to the very same float32.
        write_safetensors(path, sample["frame"].to_world(gaussians), metadata, torch.float64)
    print(f"scenes: {folder}")


def write_renderings(
    folder: Path,
    tests: FixedTasks,
    predict: Predict,
    measure: PostOptimization,
    device: torch.device,
) -> None:
    """Write the renderings of every scene's test views, before any post-optimization."""
    for index in track(range(len(tests)), "writing images"):
        sample, names = tests[index], view_names(tests.tasks[index])
        views = (sample[part].to(device) for part in ("inputs", "targets"))
        inputs, targets, rendering = measure.draw(sample["scene"], predict(sample), *views)
        write_images(folder / sample["scene"], names, rendering.image, inputs, targets)
    print(f"images: {folder}")


if __name__ == "__main__":
    evaluate()
