"""The result folder of a reconstruction: scene files, metrics, figures, a video."""

import json
import os
import tempfile
import webbrowser
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from hydra.utils import instantiate
from jaxtyping import Bool, Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from asysplat.data.photographs import Photographs
from asysplat.data.write import describe_cameras
from asysplat.errors import InputError
from asysplat.evaluation.figures import comparison_figure
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.metrics import METRICS, average, fit_exposure, write_csv
from asysplat.evaluation.seen import seen_by_inputs
from asysplat.export import write_gaussians, write_page, write_video
from asysplat.export.gaussians import CAMERAS, NO_NOTES, WRITERS, Notes
from asysplat.export.mesh import MESHES, check_mesh_packages, write_mesh
from asysplat.export.page import PAGE
from asysplat.files import atomic_write, check_writable, new_folder
from asysplat.reconstruct.video import check_video, object_center, video_cameras
from asysplat.refinement import AnchorScene, RefinementProgress
from asysplat.refinement.exposure import expose, predict_exposures
from asysplat.rendering import Rendering, render
from asysplat.runs.runs import PICTURE, SCENE
from asysplat.runs.summary import (
    RECONSTRUCTION_ROWS,
    metric_rows,
    print_missing,
    write_json,
)
from asysplat.scene import Cameras, Gaussians, Views
from asysplat.terminal import make_console, print_table

SHEET_ROWS = 4  # views in a contact sheet


class Results:
    """Write the result folder of a reconstruction, with the configuration conf/reconstruct.yaml.

    Args:
        per_view: the Gaussians depend on the view, so that no scene file holds them.
    """

    def __init__(self, folder: Path, config: DictConfig, per_view: bool = False):
        check_writable(folder.parent, "paths.logs")
        self.folder, self._config = folder, config
        self._protocol = instantiate(config.metrics)
        self._lpips = load_lpips(
            self._protocol.lpips_net, Path(config.paths.weights), config.paths.download
        )
        always = [] if per_view else [Path(SCENE).suffix]
        self._suffixes = [*read_outputs(config.output), *always]
        # The scene's files first.
        self._suffixes.sort(key=lambda suffix: (suffix in MESHES, suffix == PAGE))
        if config.open and PAGE not in self._suffixes:
            raise InputError("open=true opens the page, which output= leaves out: add html to it.")
        check_video(config.video)
        has_path = config.video.path != "none"
        self._has_video = has_path and find_spec("av") is not None
        if has_path and not self._has_video:
            print("no video: it needs PyAV, pip install 'asysplat[video]'.")
        if self._lpips is None:
            print(f"LPIPS is {self._protocol.without_lpips()}.")

    def save_start(
        self,
        gaussians: Gaussians,
        photographs: Photographs,
        background: Float[Tensor, "3"],
        exposures: Float[Tensor, "V 3"] | None = None,
    ) -> None:
        """Create the folder and write start.png: renderings before the refinement.

        Photographs and background are kept, and the `exposures` of the inputs, see
        `find_exposures`: renderings are compared with photographs under these and, for held-out
        ones, under those that the inputs around them predict.
        """
        cameras = photographs.inputs.cameras
        self._protocol.check_size(cameras.height, cameras.width)
        self.folder = new_folder(self.folder)
        self._photographs, self._background = photographs, background
        self._exposures = dict.fromkeys(("inputs", "held_out"))
        if exposures is not None:
            self._exposures["inputs"] = exposures
            if photographs.held_out is not None:
                cameras = photographs.inputs.cameras, photographs.held_out.cameras
                self._exposures["held_out"] = predict_exposures(exposures, *cameras)
        if self._lpips is not None:
            self._lpips.to(background.device)
        self._save_contact_sheet("start.png", gaussians)
        print(f"figure: {self.folder / 'start.png'}")

    def save_scene(self, gaussians: Gaussians) -> None:
        """Write the scene files."""
        photographs, background = self._photographs, self._background.tolist()
        notes = Notes(photographs.origin, background)
        world = photographs.normalization.to_world(gaussians)
        cameras = photographs.inputs.cameras.to("cpu")
        cameras = photographs.normalization.cameras_to_world(cameras)
        for suffix in self._suffixes:
            path = self.folder / f"scene{suffix}"
            if suffix in MESHES:
                write_mesh(path, world, cameras)
                continue
            if suffix != PAGE:
                save_gaussians(path, world, notes)
                continue
            names = [Path(file).name for file in photographs.input_files]
            title, center = Path(self._config.path).name, object_center(world, photographs.inputs)
            focus = None if center is None else center.tolist()
            write_page(path, world, cameras, names, title, background, focus=focus)

    def save(self, scene: Gaussians | AnchorScene, progress: RefinementProgress) -> None:
        """Write the scene files, then cameras, the configuration, a contact sheet and metrics."""
        if isinstance(scene, Gaussians):
            self.save_scene(scene)
        self._save_cameras()
        OmegaConf.save(self._config, self.folder / "config.yaml", resolve=True)
        self._save_contact_sheet(PICTURE, scene)
        self._save_metrics(scene, progress)

    def save_video(self, scene: Gaussians | AnchorScene) -> None:
        """Write the video, print where the results are, and open the page on request."""
        photographs = self._photographs
        if self._has_video:
            path = video_cameras(self._config.video, photographs, scene)
            images = (
                self._draw(scene, path.select([frame]), depth=False).image[0]
                for frame in range(path.num_views)
            )
            write_video(self.folder / "path.mp4", images, self._config.video.fps)
        if any(photographs.origin) and self._suffixes:
            offset = " ".join(map(repr, photographs.origin))
            print(f"add the offset in its header, {offset}, for the coordinates of the photographs")
        print(f"figure: {self.folder / PICTURE}")
        if self._has_video:
            print(f"video: {self.folder / 'path.mp4'}")
        files = [self.folder / f"scene{suffix}" for suffix in self._suffixes]
        for file in [file for file in files if file.suffix != PAGE][:1]:
            print(f"viewer: asysplat view {file}")
            print(f"scene: {file}")
        for suffix in MESHES:
            if suffix in self._suffixes:
                print(f"mesh: {self.folder / f'scene{suffix}'}")
        for page in (file for file in files if file.suffix == PAGE):
            print(f"page: {page}")
            if self._config.open:
                webbrowser.open(page.absolute().as_uri())

    def _save_cameras(self) -> None:
        photographs = self._photographs
        files = map(os.path.abspath, photographs.input_files + photographs.held_out_files)
        cameras = photographs.normalization.cameras_to_world(photographs.cameras.to("cpu"))
        with atomic_write(self.folder / CAMERAS) as path:
            path.write_text(json.dumps(describe_cameras(cameras, list(files)), indent=1))

    def _draw(
        self, scene: Gaussians | AnchorScene, cameras: Cameras, depth: bool = True
    ) -> Rendering:
        if isinstance(scene, AnchorScene):
            return scene.render(cameras, self._background, depth=depth)
        return render(scene, cameras, self._background, depth=depth, views_at_once=1)

    def _save_metrics(self, scene: Gaussians | AnchorScene, progress: RefinementProgress) -> None:
        """Write metrics.json and metrics.csv, and print the table."""
        results: dict[str, float | int | str] = {"gaussians": scene.num_gaussians}
        results |= {"steps": progress.step, "seconds": progress.seconds}
        results |= self._protocol.notes(self._lpips)
        photographs, rows = self._photographs, []
        inputs, held_out = photographs.inputs, photographs.held_out
        numbers: dict[str, list[dict[str, float]]] = {"inputs": []}

        def input_depths() -> Iterator[Float[Tensor, "h w"]]:
            for row, drawn in self._measure(scene, inputs, self._exposures["inputs"]):
                numbers["inputs"].append(row)
                yield _depth(drawn)[0]

        if held_out is None:
            deque(input_depths(), maxlen=0)
        else:
            measured = [*self._measure(scene, held_out, self._exposures["held_out"])]
            depth = torch.cat([_depth(drawn) for _, drawn in measured])
            shown = seen_by_inputs(depth, held_out.cameras, input_depths(), inputs.cameras)
            numbers["held_out"] = [
                row | self._of_seen(drawn.image, held_out.one(view), shown[[view]])
                for view, (row, drawn) in enumerate(measured)
            ]
        files = {"inputs": photographs.input_files, "held_out": photographs.held_out_files}
        for name, of_views in numbers.items():
            results |= _means(name, of_views)
            labels = ({"set": name, "file": file} for file in files[name])
            rows += [label | row for label, row in zip(labels, of_views, strict=True)]
        if held_out is not None:
            baselines = self._protocol.measure_baselines(inputs, held_out, self._lpips)
            for name, of_views in baselines.items():
                results |= _means(f"baseline/{name}", of_views)
        write_json(self.folder / "metrics.json", results)
        write_csv(self.folder / "metrics.csv", rows)
        _print_table(results)

    @torch.no_grad()
    def _measure(
        self,
        scene: Gaussians | AnchorScene,
        views: Views,
        exposures: Float[Tensor, "V 3"] | None,
    ) -> Iterator[tuple[dict[str, float], Rendering]]:
        """Yield the metrics and the rendering of each of [V] views, which are not kept.

        Beside the metrics is the PSNR with a gain and an offset fitted to each image.
        """
        for view in range(views.num_views):
            target = views.one(view)
            seen = scene if isinstance(scene, Gaussians) else scene.decode(target.cameras).gaussians
            draw = partial(render, seen, target.cameras, self._background, masks=target.masks)
            drawn = draw()
            median = None if target.depths is None else draw(depth="median").depth
            image = drawn.image if exposures is None else expose(drawn.image, exposures[[view]])
            (row,) = self._protocol.measure_views(
                image, drawn.depth, target, self._lpips, median_depths=median
            )
            fitted = fit_exposure(drawn.image, target.images, target.masks)
            row["fitted/psnr"] = self._protocol.psnr(fitted, target).item()
            yield row, replace(drawn, image=image)

    def _of_seen(
        self, image: Float[Tensor, "1 3 H W"], target: Views, shown: Bool[Tensor, "1 H W"]
    ) -> dict[str, float]:
        """Compute the share of the pixels that inputs see, and their PSNR."""
        of_pixels = replace(self._protocol, psnr_over="masks")
        seen = shown if target.masks is None else shown & target.masks
        quality = of_pixels.psnr(image, replace(target, masks=seen)).item()
        return {"seen/share": shown.float().mean().item(), "seen/psnr": quality}

    @torch.no_grad()
    def _save_contact_sheet(self, name: str, scene: Gaussians | AnchorScene) -> None:
        """Draw some held-out views, or inputs without any: image, rendering, error and depth."""
        inputs, held_out = self._photographs.inputs, self._photographs.held_out
        kind, views = ("inputs", inputs) if held_out is None else ("held_out", held_out)
        rows = min(SHEET_ROWS, views.num_views)
        shown = torch.linspace(0, views.num_views - 1, rows).round().long()
        views, exposures = views.select(shown).decoded(), self._exposures[kind]
        rendering = self._draw(scene, views.cameras)
        if exposures is not None:
            image = expose(rendering.image, exposures[shown.to(exposures.device)])
            rendering = replace(rendering, image=image)
        figure = comparison_figure(inputs, views, rendering)
        with atomic_write(self.folder / name) as path:
            figure.savefig(path, dpi=110)


def read_outputs(output: str | Sequence[str]) -> list[str]:
    """Return the suffixes of the files of a scene that `output` names."""
    names = [output] if isinstance(output, str) else output
    for name in names:
        if f".{name}" in MESHES:
            check_mesh_packages(f"output={name}")
        elif f".{name}" not in WRITERS:
            known = ", ".join(suffix[1:] for suffix in (*WRITERS, *MESHES))
            raise InputError(f"output has {name!r}: choose from {known}.")
    return [f".{name}" for name in names if f".{name}" != Path(SCENE).suffix]


def save_gaussians(path: Path, gaussians: Gaussians, notes: Notes = NO_NOTES) -> None:
    """Write a scene; where that fails, write it elsewhere, as the refinement took long."""
    try:
        write_gaussians(path, gaussians, notes)
    except InputError as failure:
        for folder in (Path(tempfile.gettempdir()), Path.home()):
            rescued = folder / f"{path.parent.name}-{path.name}"
            try:
                write_gaussians(rescued, gaussians, notes)
            except InputError:
                continue
            raise InputError(f"{failure} The scene was written to {rescued}.") from None
        raise


def _depth(drawn: Rendering) -> Float[Tensor, "V H W"]:
    assert drawn.depth is not None
    return drawn.depth


def _means(name: str, rows: list[dict[str, float]]) -> dict[str, float]:
    return {f"{name}/{metric}": mean for metric, mean in average(rows, "images").items()}


def _print_table(results: dict[str, float | int | str]) -> None:
    shown = [*RECONSTRUCTION_ROWS.values(), "missing"]
    metrics = [m for m in METRICS if any(f"{prefix}/{m}" in results for prefix in shown)]
    rows = metric_rows(results, RECONSTRUCTION_ROWS, metrics)
    print_table(make_console(), ["", *(METRICS[metric] for metric in metrics)], rows)
    print_missing(results)
