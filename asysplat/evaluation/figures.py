"""Draw figures of a run: comparisons of renderings with targets, and the learning curve."""

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure

from asysplat.evaluation.metrics import BASELINES, psnr
from asysplat.rendering import Rendering
from asysplat.scene import Views, inverse_depths

DEPTH_ERROR = "depth error, 0 to 0.25"  # |d - t| / t
ERRORS = {"error": 0.5, DEPTH_ERROR: 0.25}  # title: at the bright end of the color map


def comparison_figure(inputs: Views, targets: Views, rendering: Rendering) -> Figure:
    """Draw a row of images for each target view of one scene; no field has a batch dimension.

    The nearest input, the target, the rendering with its PSNR, the absolute error, the rendered
    inverse depth and, where the data has depths, the true one on the same scale and the relative
    error of the rendered depth, not aligned, with AbsRel. What a mask excludes is gray, and so are
    the last two where the depth is unknown.
    """
    images = {
        "nearest input": inputs.nearest_images(targets.cameras),
        "target": targets.images,
        "rendered": rendering.image,
    }
    maps = {"error": (rendering.image.clamp(0, 1) - targets.images).abs().mean(1)}
    if rendering.depth is not None:
        maps["inverse depth"] = inverse_depths(rendering.depth)
    if (true := targets.known_depths) is not None:
        true = true.where(true > 0, torch.nan)
        maps["true inverse depth"] = 1 / true
        if rendering.depth is not None:
            maps[DEPTH_ERROR] = (rendering.depth - true).abs() / true
    if targets.masks is not None:
        maps = {name: values.where(targets.masks, torch.nan) for name, values in maps.items()}
    maps = {name: values.cpu().float() for name, values in maps.items()}
    titles = (*images, *maps)
    quality = psnr(targets.masked(rendering.image), targets.images)
    aspect = targets.cameras.height / targets.cameras.width
    size = (2 * len(titles), 2 * aspect * targets.num_views + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    shape = targets.num_views, len(titles)
    axes = figure.subplots(*shape, squeeze=False, subplot_kw={"facecolor": "gray"})
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    for view, row in enumerate(axes):
        for axis, image in zip(row, images.values(), strict=False):
            axis.imshow(image[view].clamp(0, 1).permute(1, 2, 0).cpu().float().numpy())
        row[2].set_xlabel(f"{quality[view]:.1f} dB", fontsize=8)
        disparities = [values[view] for title, values in maps.items() if title not in ERRORS]
        for axis, (title, values) in zip(row[3:], maps.items(), strict=True):
            if title in ERRORS:
                style = {"cmap": "magma", "vmax": ERRORS[title]}
            else:
                near = disparities[-1].flatten().nanquantile(0.99).nan_to_num().item()
                style = {"cmap": "viridis", "vmax": near}
            axis.imshow(values[view].numpy(), vmin=0, **style)
        if DEPTH_ERROR in maps:
            row[-1].set_xlabel(f"AbsRel {maps[DEPTH_ERROR][view].nanmean():.3f}", fontsize=8)
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
