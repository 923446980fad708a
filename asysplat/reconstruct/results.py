"""The result folder of a reconstruction: scene files, metrics, figures, a video."""

import csv
from importlib.util import find_spec
from pathlib import Path

import torch
from hydra.utils import instantiate
from jaxtyping import Float
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import Tensor

from asysplat.errors import InputError
from asysplat.evaluation.baselines import BASELINES
from asysplat.evaluation.figures import comparison_figure
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.scene import measure_scene
from asysplat.export.orbit import orbit
from asysplat.export.path import smoothed_path
from asysplat.export.ply import write_ply
from asysplat.export.tensors import write_safetensors
from asysplat.export.video import write_video
from asysplat.files import atomic_write
from asysplat.refinement.photographs import Photographs
from asysplat.refinement.refine import RefinementProgress
from asysplat.rendering import Rendering, render
from asysplat.scene import Gaussians, Views
from asysplat.training.summary import write_json

CAMERA_PATHS = {"own": smoothed_path, "orbit": orbit}
SHEET_ROWS = 4  # views in a contact sheet
DPI = 110
TABLE_ROWS = {
    "held_out": "held out",
    "inputs": "inputs",
    "baseline/nearest_view": "nearest view, copied",
    "baseline/mean_color": "mean color",
}


class Results:
    """Write the result folder of a reconstruction.

    Args:
        folder: created with the first file.
        config: see conf/reconstruct.yaml.

    Raises:
        InputError: an unknown camera path of the video.
    """

    def __init__(self, folder: Path, config: DictConfig):
        self.folder, self._config = folder, config
        self._protocol = instantiate(config.metrics)
        self._lpips = load_lpips(
            self._protocol.lpips_net, Path(config.paths.weights), config.paths.download
        )
        path = config.video.path
        if path not in (*CAMERA_PATHS, "none"):
            raise InputError(f"video.path={path}: choose {', '.join(CAMERA_PATHS)} or none.")
        self._has_video = path != "none" and find_spec("av") is not None
        if path != "none" and not self._has_video:
            print("no video: it needs PyAV, pip install 'asysplat[video]'.")
        if self._lpips is None:
            print("no LPIPS: its weights are missing; paths.download=true downloads them.")

    def save_start(
        self, gaussians: Gaussians, photographs: Photographs, background: Float[Tensor, "3"]
    ) -> None:
        """Write start.png: renderings before the refinement.

        Raises:
            InputError: the folder cannot be created or written to.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be created ({error.strerror}): set paths.logs to a folder "
                "that you may write to."
            ) from error
        self._save_figure("start.png", contact_sheet(gaussians, photographs, background))
        print(f"figure: {self.folder / 'start.png'}")

    def save(
        self,
        gaussians: Gaussians,
        photographs: Photographs,
        background: Float[Tensor, "3"],
        progress: RefinementProgress | None,
    ) -> None:
        """Write the scene files, then the configuration, figures, metrics and the video."""
        world = photographs.frame.to_world(gaussians)
        write_ply(self.folder / "scene.ply", world)
        color = " ".join(f"{value:.6f}" for value in background.tolist())
        write_safetensors(self.folder / "scene.safetensors", world, {"background": color})
        OmegaConf.save(self._config, self.folder / "config.yaml", resolve=True)
        self._save_figure("contact.png", contact_sheet(gaussians, photographs, background))
        self._save_metrics(gaussians, photographs, background, progress)
        if self._has_video:
            video = self._config.video
            frames = max(1, round(video.seconds * video.fps))
            path = CAMERA_PATHS[video.path](photographs.inputs.cameras, frames)
            images = (
                render(gaussians, path.select([frame]), background, depth=False).image[0]
                for frame in range(path.num_views)
            )
            write_video(self.folder / "path.mp4", images, video.fps)
        print(f"scene: {self.folder / 'scene.ply'}")

    def _save_metrics(
        self,
        gaussians: Gaussians,
        photographs: Photographs,
        background: Float[Tensor, "3"],
        progress: RefinementProgress | None,
    ) -> None:
        """Write metrics.json and metrics.csv, and print the table."""
        results: dict[str, float | int | str] = {"gaussians": gaussians.num_gaussians}
        if progress is not None:
            results |= {"steps": progress.step, "seconds": progress.seconds}
        sentences = self._protocol.sentences()
        results |= {f"protocol/{name}": sentence for name, sentence in sentences.items()}
        inputs, held_out, rows = photographs.inputs, photographs.held_out, []
        sets = {"inputs": (inputs, photographs.input_files)}
        if held_out is not None:
            sets["held_out"] = (held_out, photographs.held_out_files)
        for name, (views, files) in sets.items():
            metrics = measure_scene(gaussians, views, background, self._protocol, self._lpips)
            results |= {f"{name}/{metric}": _mean(values) for metric, values in metrics.items()}
            for view, file in enumerate(files):
                row = {metric: values[view] for metric, values in metrics.items()}
                rows.append({"set": name, "file": file, **row})
        if held_out is not None:
            results |= self._baselines(inputs, held_out)
        write_json(self.folder / "metrics.json", results)
        with atomic_write(self.folder / "metrics.csv") as path, open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
            writer.writeheader()
            writer.writerows(rows)
        _print_table(results)

    def _baselines(self, inputs: Views, held_out: Views) -> dict[str, float]:
        """Measure what a copy of the nearest input, and the mean color of all, achieve."""
        values: dict[str, list[float]] = {}
        for name, draw in BASELINES.items():
            images = draw(inputs, held_out)
            for view in range(held_out.num_views):  # SSIM of all at once takes much memory
                metrics = self._protocol.image_metrics(
                    images[[view]], held_out.select([view]), self._lpips
                )
                for metric, value in metrics.items():
                    values.setdefault(f"baseline/{name}/{metric}", []).append(value.item())
        return {name: _mean(of_views) for name, of_views in values.items()}

    def _save_figure(self, name: str, figure: Figure) -> None:
        with atomic_write(self.folder / name) as path:
            figure.savefig(path, dpi=DPI)


@torch.no_grad()
def contact_sheet(
    gaussians: Gaussians, photographs: Photographs, background: Float[Tensor, "3"]
) -> Figure:
    """Draw some held-out views, or inputs without any: image, rendering, error and depth."""
    views = photographs.inputs if photographs.held_out is None else photographs.held_out
    rows = min(SHEET_ROWS, views.num_views)
    views = views.select(torch.linspace(0, views.num_views - 1, rows).round().long())
    outs = [render(gaussians, views.cameras.select([view]), background) for view in range(rows)]
    tensors = {
        name: torch.cat([getattr(out, name) for out in outs])
        for name in ("image", "alpha", "depth")
    }
    return comparison_figure(photographs.inputs, views, Rendering(**tensors, stats={}))


def _mean(values: list[float]) -> float:
    return torch.tensor(values).nanmean().item()


def _print_table(results: dict[str, float | int | str]) -> None:
    metrics = ("psnr", "ssim", "lpips", "absrel", "delta1")
    columns = [m for m in metrics if any(f"{row}/{m}" in results for row in TABLE_ROWS)]
    table = Table("", *columns)
    for row, name in TABLE_ROWS.items():
        if f"{row}/psnr" in results:
            cells = (results.get(f"{row}/{metric}") for metric in columns)
            table.add_row(name, *("" if cell is None else f"{cell:.3f}" for cell in cells))
    Console().print(table)
