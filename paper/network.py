"""Draw a network as it is built: stages, layers, tokens, parameters, links (Figures 2 and 3)."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from torch import nn

from asysplat.errors import InputError
from asysplat.evaluation.static_cost import count_parameters
from asysplat.models.asysplat import AsySplat
from asysplat.models.attention import FullAttention, SparseAttention
from asysplat.models.layers import Tokenizer
from asysplat.models.mamba import BiMamba2, MambaVision
from asysplat.models.network import Network
from asysplat.models.single_branch import SingleBranch
from paper.style import FAINT, INK, OURS, PAPER, STYLE

KINDS = {
    BiMamba2: ("Mamba2, both directions", OURS),
    SparseAttention: ("sparse attention", PAPER),
    FullAttention: ("full attention", "#8250df"),
    MambaVision: ("MambaVision", "#2f8f4e"),
}
LAYER, STAGE = 0.2, 3.4  # widths of a layer and, with its link, of a stage
MIDDLES = (1.0, -1.0)  # of the branches
HIGHEST = 1.1  # height of the widest layer
FRAMES, TOKENS = 3, 6  # drawn of the attention's grid: frames, and tokens along a side of each


class DrawnStage(NamedTuple):
    """The layers of a stage, their width, and the link through which its branch reads."""

    layers: Sequence[nn.Module]
    width: int
    link: nn.Module


class DrawnBranch(NamedTuple):
    """A branch from its tokens on."""

    name: str
    tokenizer: Tokenizer
    stages: list[DrawnStage]


def list_branches(net: Network) -> list[DrawnBranch]:
    """List what is drawn of a network of stages."""
    if isinstance(net, SingleBranch):
        layers = [stage.layers for stage in net.stages]
        links = [stage.merge or nn.Identity() for stage in net.stages[1:]] + [nn.Identity()]
        stages = list(map(DrawnStage, layers, net.widths.stages, links))
        return [DrawnBranch("tokens", net.tokenizer, stages)]
    if not isinstance(net, AsySplat):
        raise InputError(
            f"network= of a {type(net).__name__}, which has no stages of layers: name a model of "
            "one or two branches, such as asysplat_4m4s or longlrm."
        )
    fine = [net.widths.fine] * len(net.widths.stages)
    layers = [stage.layers for stage in net.geometry.stages]
    geometry = list(map(DrawnStage, layers, net.widths.stages, net.geometry.links))
    appearance = list(map(DrawnStage, net.appearance.stages, fine, net.appearance.links))
    return [
        DrawnBranch("geometry", net.geometry.tokenizer, geometry),
        DrawnBranch("appearance", net.appearance.tokenizer, appearance),
    ]


def draw_network(net: Network, views: int, height: int, width: int) -> Figure:
    """Draw a network for `views` input views of `height` x `width` pixels, and its grid."""
    branches = list_branches(net)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(14, 1.2 + 1.7 * len(branches)), layout="constrained")
        axes, inset = figure.subplots(1, 2, width_ratios=[6, 1])
        for branch, middle in zip(branches, MIDDLES, strict=False):
            patch = branch.tokenizer.patch
            tokens = f"{views} x {height // patch} x {width // patch} tokens of {patch}x{patch}"
            title = f"{branch.name}: {tokens}"
            axes.text(0, 1.85 * middle, title, color=INK, weight="bold", va="center")
            _draw_branch(axes, branch, middle, max(net.widths.stages), len(branches) > 1)
        count = len(branches[0].stages)
        middle = sum(MIDDLES[: len(branches)]) / len(branches)
        side = net.head.stride
        text = [f"head {_millions(net.head)}"]
        if isinstance(net, AsySplat):
            text.append(f"fusion {_millions(net.fusion)}")
        text.append(f"{views * (height // side) * (width // side):,} Gaussians")
        axes.text(count * STAGE, middle, "\n".join(text), va="center", color=INK)
        share = f", {net.geometry_ratio():.1%} for geometry" if len(branches) > 1 else ""
        axes.set_title(f"{count_parameters(net) / 1e6:.2f}M parameters{share}", loc="left")
        axes.set(
            xlim=(-0.1, count * STAGE + 1.6), ylim=(2.6 * MIDDLES[0] - 2.5 * len(branches), 2.1)
        )
        axes.set_axis_off()
        used = {
            type(layer) for branch in branches for stage in branch.stages for layer in stage.layers
        }
        handles = [
            Patch(color=color, label=name) for kind, (name, color) in KINDS.items() if kind in used
        ]
        axes.legend(handles=handles, loc="lower left", ncols=len(KINDS), frameon=False)
        sparse = [module for module in net.modules() if isinstance(module, SparseAttention)]
        _draw_grid(inset, sparse[0].attention.grid if sparse else None)
    return figure


def _draw_branch(
    axes: Axes, branch: DrawnBranch, middle: float, widest: int, is_linked: bool
) -> None:
    """Draw a branch's layers as bars as high as they are wide, and arrows to what reads it."""
    lowest = middle - HIGHEST / 2 * max(stage.width for stage in branch.stages) / widest - 0.2
    for place, stage in enumerate(branch.stages):
        start, high = place * STAGE, HIGHEST * stage.width / widest
        for number, layer in enumerate(stage.layers):
            color = KINDS[type(layer)][1] if type(layer) in KINDS else FAINT
            corner = start + number * LAYER, middle - high / 2
            axes.add_patch(Rectangle(corner, 0.8 * LAYER, high, color=color, lw=0))
        label = f"{len(stage.layers)} layers, {stage.width} wide, {_millions(*stage.layers)}"
        axes.text(start, lowest, label, color=INK, fontsize=9, va="center")
        end, following = start + len(stage.layers) * LAYER, (place + 1) * STAGE - 0.1
        arrow = {"arrowstyle": "->", "color": FAINT}
        axes.annotate("", (following, middle), (end, middle), arrowprops=arrow)
        parameters = count_parameters(stage.link)
        if is_linked and parameters:  # from the other branch
            x = following - (0.55 if middle > 0 else 1.05)
            axes.annotate("", (x, 0.9 * middle), (x, -0.9 * middle), arrowprops=arrow)
            axes.text(x + 0.05, -0.2, _millions(stage.link), color=INK, fontsize=9)
        elif parameters:
            axes.text(end + 0.1, middle + 0.1, "2 x 2 tokens to one", color=INK, fontsize=9)


def _draw_grid(axes: Axes, grid: int | None) -> None:
    """Draw which tokens of all frames attend to each other: those of one color."""
    axes.set_axis_off()
    if grid is None:
        return
    colors = [color for _, color in KINDS.values()]
    for frame in range(FRAMES):
        shift = 0.9 * frame
        for row in range(TOKENS):
            for column in range(TOKENS):
                place = row % grid * grid + column % grid
                corner = column + shift, -row + shift
                color = colors[place % len(colors)]
                axes.add_patch(Rectangle(corner, 0.85, 0.85, fc=color, ec="white", zorder=-frame))
    axes.set(xlim=(-0.3, TOKENS + 2.2), ylim=(-TOKENS - 0.2, 3.2), aspect="equal")
    axes.set_title(
        f"sparse attention, grid {grid} x {grid}:\nwithin a color, in all frames", fontsize=9
    )


def _millions(*modules: nn.Module) -> str:
    return f"{sum(map(count_parameters, modules)) / 1e6:.2f}M"
