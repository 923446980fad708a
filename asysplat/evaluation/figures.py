"""Draw figures of a run: comparisons of renderings with targets, and the learning curve."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure

from asysplat.evaluation.metrics import BASELINES, nearest_view_images, psnr
from asysplat.rendering import Rendering
from asysplat.scene import Views, inverse_depths

MAX_ERROR = 0.5  # at the bright end of the color map


def comparison_figure(inputs: Views, targets: Views, rendering: Rendering) -> Figure:
    """Draw a row of images for each target view of one scene; no field has a batch dimension.

    The nearest input, the target, the rendering with its PSNR, the absolute error, the rendered
    inverse depth and the true one on the same scale, if known; what a mask excludes is blank.
    """
    images = {
        "nearest input": nearest_view_images(inputs, targets),
        "target": targets.images,
        "rendered": rendering.image,
    }
    maps = {"error": (rendering.image.clamp(0, 1) - targets.images).abs().mean(1)}
    if rendering.depth is not None:
        maps["inverse depth"] = inverse_depths(rendering.depth)
    if targets.depths is not None:
        maps["true inverse depth"] = inverse_depths(targets.depths)
    if targets.masks is not None:
        maps = {name: values.where(targets.masks, torch.nan) for name, values in maps.items()}
    titles = (*images, *maps)
    quality = psnr(targets.masked(rendering.image), targets.images)
    aspect = targets.cameras.height / targets.cameras.width
    size = (2 * len(titles), 2 * aspect * targets.num_views + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(targets.num_views, len(titles), squeeze=False)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    for view, row in enumerate(axes):
        for axis, image in zip(row, images.values(), strict=False):
            axis.imshow(image[view].clamp(0, 1).permute(1, 2, 0).cpu().float().numpy())
        row[2].set_xlabel(f"{quality[view]:.1f} dB", fontsize=8)
        error, *disparities = (values[view].cpu().float() for values in maps.values())
        row[3].imshow(error.numpy(), cmap="magma", vmin=0, vmax=MAX_ERROR)
        for axis, values in zip(row[4:], disparities, strict=True):
            near = disparities[-1].flatten().nanquantile(0.99).nan_to_num().item()
            axis.imshow(values.numpy(), cmap="viridis", vmin=0, vmax=near)
        for axis in row:
            axis.set(xticks=[], yticks=[])
    return figure


def learning_curve(rows: Sequence[Mapping[str, float | int]]) -> Figure:
    """Draw the PSNR of each validation, a row, and that of the baselines."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axis = figure.subplots()
    minutes, trained = ([row[name] for row in rows] for name in ("minutes", "psnr"))
    axis.plot(minutes, trained, "o-", label="trained")
    for number, (name, (title, _)) in enumerate(BASELINES.items(), 1):
        axis.axhline(rows[-1][f"{name}/psnr"], color=f"C{number}", ls="--", label=title)
    axis.set(xlabel="minutes of training", ylabel="validation PSNR (dB)")
    axis.set_title(f"{rows[-1]['step']:.0f} steps", fontsize=9)
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)
    return figure
