"""Figures of a run: input, target, rendering, error and depth side by side; learning curve."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from asysplat.evaluation.baselines import nearest_view_images
from asysplat.evaluation.metrics import psnr
from asysplat.rendering import Rendering
from asysplat.scene import Views

ERROR_RANGE = 0.5  # the error that is shown brightest


def comparison_figure(inputs: Views, targets: Views, rendering: Rendering) -> Figure:
    """Draw a row of images for each target view of one scene; no field has a batch dimension.

    Columns: the nearest input, the target, the rendering with its PSNR, the absolute error, the
    rendered inverse depth and, if the data has depths, the true one on the same scale. Pixels that
    a mask excludes are blank in the last three.
    """
    nearest = nearest_view_images(inputs, targets)
    quality = psnr(targets.masked(rendering.image), targets.images)
    everywhere = torch.ones_like(targets.images[:, 0], dtype=torch.bool)
    counts = everywhere if targets.masks is None else targets.masks
    columns = 5 if targets.depths is None else 6
    rows = targets.num_views
    aspect = targets.cameras.height / targets.cameras.width
    figure = Figure(figsize=(2 * columns, 2 * aspect * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    titles = ("nearest input", "target", "rendered", "error", "inverse depth", "true inverse depth")
    for axis, title in zip(axes[0], titles, strict=False):
        axis.set_title(title, fontsize=9)
    for view, row in enumerate(axes):
        target = targets.images[view]
        error = (rendering.image[view].clamp(0, 1) - target).abs().mean(0)
        error = error.where(counts[view], torch.nan)
        disparities = [disparity(rendering.depth[view]).where(counts[view], torch.nan)]
        if targets.depths is not None:
            disparities.append(disparity(targets.depths[view]).where(counts[view], torch.nan))
        nearest_is_bright = disparities[-1].flatten().nanquantile(0.99).nan_to_num().item()
        for axis, image in zip(row, (nearest[view], target, rendering.image[view]), strict=False):
            axis.imshow(image.clamp(0, 1).permute(1, 2, 0).cpu().float().numpy())
        row[2].set_xlabel(f"{quality[view]:.1f} dB", fontsize=8)
        row[3].imshow(error.cpu().float().numpy(), cmap="magma", vmin=0, vmax=ERROR_RANGE)
        for axis, values in zip(row[4:], disparities, strict=True):
            axis.imshow(
                values.cpu().float().numpy(), cmap="viridis", vmin=0, vmax=nearest_is_bright
            )
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    return figure


def disparity(depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Compute 1 / depth; 0, as at infinity, where the depth is unknown."""
    return torch.where(depth > 0, 1 / depth.where(depth > 0, 1), 0)


def learning_curve(rows: Sequence[Mapping[str, float | int]]) -> Figure:
    """Draw the validation PSNR over training, and that of two baselines without training.

    Args:
        rows: one for each validation, with minutes, step, psnr, nearest_view/psnr and
            mean_color/psnr.
    """
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axis = figure.subplots()
    minutes = [row["minutes"] for row in rows]
    axis.plot(minutes, [row["psnr"] for row in rows], "o-", label="trained")
    axis.axhline(
        rows[-1]["nearest_view/psnr"], color="tab:orange", ls="--", label="nearest view, copied"
    )
    axis.axhline(rows[-1]["mean_color/psnr"], color="tab:gray", ls=":", label="mean color")
    axis.set(xlabel="minutes of training", ylabel="validation PSNR (dB)")
    axis.set_title(f"{rows[-1]['step']:.0f} steps", fontsize=9)
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)
    return figure
