"""What a reconstruction hands over: files of the scene, a video, pictures, numbers."""

import csv
from collections.abc import Iterator
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
from asysplat.evaluation.baselines import mean_color_images
from asysplat.evaluation.baselines import nearest_view_images
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
from asysplat.scene import Cameras, Gaussians, Views
from asysplat.training.summary import write_json

PATHS = {"own": smoothed_path, "orbit": orbit}
ROWS = 4  # views in a contact sheet
DPI = 110


class Results:
    """The folder of a reconstruction.

    Args:
        folder: is made when the first file is written.
        config: see conf/reconstruct.yaml.

    Raises:
        InputError: an unknown path of the video.
    """

    def __init__(self, folder: Path, config: DictConfig):
        self.folder, self._config = folder, config
        self._protocol = instantiate(config.metrics)
        self._lpips = load_lpips(
            self._protocol.lpips_net, Path(config.paths.weights), config.paths.download
        )
        path = config.video.path
        if path not in (*PATHS, "none"):
            raise InputError(f"video.path={path}: choose {', '.join(PATHS)} or none.")
        self._films = path != "none" and find_spec("av") is not None
        if path != "none" and not self._films:
            print("the video is left out: it needs PyAV, pip install 'asysplat[video]'.")
        if self._lpips is None:
            print("LPIPS is left out: its weights are not here (paths.download=true fetches them).")

    def first_picture(
        self, gaussians: Gaussians, photographs: Photographs, background: Float[Tensor, "3"]
    ) -> None:
        """Write start.png: what the refinement starts from.

        Raises:
            InputError: the folder cannot be made, or written to.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be made ({error.strerror}): set paths.logs to a folder that "
                "you may write to."
            ) from error
        self._save("start.png", contact_sheet(gaussians, photographs, background))
        print(f"picture: {self.folder / 'start.png'}")

    def save(
        self,
        gaussians: Gaussians,
        photographs: Photographs,
        background: Float[Tensor, "3"],
        progress: RefinementProgress | None,
    ) -> None:
        """Write the scene first, then pictures, numbers and the video."""
        world = photographs.frame.to_world(gaussians)
        write_ply(self.folder / "scene.ply", world)
        color = " ".join(f"{value:.6f}" for value in background.tolist())
        write_safetensors(self.folder / "scene.safetensors", world, {"background": color})
        OmegaConf.save(self._config, self.folder / "config.yaml", resolve=True)
        self._save("contact.png", contact_sheet(gaussians, photographs, background))
        self._numbers(gaussians, photographs, background, progress)
        if self._films:
            self._video(gaussians, photographs.inputs.cameras, background)
        print(f"scene: {self.folder / 'scene.ply'}")

    def _numbers(
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
        results |= {f"protocol/{name}": said for name, said in self._protocol.sentences().items()}
        inputs, rows = photographs.inputs, []
        sets = {"inputs": (inputs, photographs.input_files)}
        if photographs.measured is not None:
            sets["held_out"] = (photographs.measured, photographs.measured_files)
        for name, (views, files) in sets.items():
            found = measure_scene(gaussians, views, background, self._protocol, self._lpips)
            results |= {f"{name}/{metric}": _mean(values) for metric, values in found.items()}
            for view, file in enumerate(files):
                rows.append({"set": name, "file": file, **{m: v[view] for m, v in found.items()}})
        if photographs.measured is not None:
            results |= self._baselines(inputs, photographs.measured)
        write_json(self.folder / "metrics.json", results)
        with atomic_write(self.folder / "metrics.csv") as path, open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
            writer.writeheader()
            writer.writerows(rows)
        _print_table(results)

    def _baselines(self, inputs: Views, measured: Views) -> dict[str, float]:
        """Measure what one gets without a reconstruction."""
        drawn = {
            "nearest_view": nearest_view_images(inputs, measured),
            "mean_color": mean_color_images(inputs, measured),
        }
        found: dict[str, list[float]] = {}
        for name, images in drawn.items():
            for view in range(measured.num_views):  # SSIM of all at once takes much memory
                one = self._protocol.image_metrics(
                    images[[view]], measured.select([view]), self._lpips
                )
                for metric, value in one.items():
                    found.setdefault(f"baseline/{name}/{metric}", []).append(value.item())
        return {name: _mean(values) for name, values in found.items()}

    def _video(
        self, gaussians: Gaussians, cameras: Cameras, background: Float[Tensor, "3"]
    ) -> None:
        video = self._config.video
        path = PATHS[video.path](cameras, max(1, round(video.seconds * video.fps)))

        def frames() -> Iterator[Float[Tensor, "3 H W"]]:
            for frame in range(path.num_views):
                yield render(gaussians, path.select([frame]), background, depth=False).image[0]

        write_video(self.folder / "path.mp4", frames(), video.fps)

    def _save(self, name: str, figure: Figure) -> None:
        with atomic_write(self.folder / name) as path:
            figure.savefig(path, dpi=DPI)


@torch.no_grad()
def contact_sheet(
    gaussians: Gaussians, photographs: Photographs, background: Float[Tensor, "3"]
) -> Figure:
    """Draw some views, held out ones if there are any: photograph, rendering, error, depth."""
    views = photographs.inputs if photographs.measured is None else photographs.measured
    chosen = torch.linspace(0, views.num_views - 1, min(ROWS, views.num_views)).round().long()
    views = views.select(chosen)
    outs = [render(gaussians, views.cameras.select([v]), background) for v in range(len(chosen))]
    rendering = Rendering(
        image=torch.cat([out.image for out in outs]),
        alpha=torch.cat([out.alpha for out in outs]),
        depth=torch.cat([out.depth for out in outs]),
        stats={},
    )
    return comparison_figure(photographs.inputs, views, rendering)


def _mean(values: list[float]) -> float:
    return torch.tensor(values).nanmean().item()


def _print_table(results: dict[str, float | int | str]) -> None:
    rows = {
        "held_out": "held out",
        "inputs": "inputs",
        "baseline/nearest_view": "nearest view, copied",
        "baseline/mean_color": "mean color",
    }
    metrics = ("psnr", "ssim", "lpips", "absrel", "delta1")
    shown = [m for m in metrics if any(f"{row}/{m}" in results for row in rows)]
    table = Table("", *shown)
    for row, name in rows.items():
        if f"{row}/psnr" in results:
            cells = (results.get(f"{row}/{metric}") for metric in shown)
            table.add_row(name, *("" if cell is None else f"{cell:.3f}" for cell in cells))
    Console().print(table)
