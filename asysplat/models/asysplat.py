"""AsySplat: posed images to Gaussians through two asymmetric branches (paper, Sec. 3.2)."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.geometry_ratio import solve_widths
from asysplat.models.head import GaussianHead
from asysplat.models.layers import Layers, StageShape, Tokenizer, Widths
from asysplat.models.network import TokenNetwork
from asysplat.models.stage import MAX_LAYERS, Component, Stage, build_component

APPEARANCE_MLP_RATIO = 4


class Branch(nn.Module):
    """The parts of a branch: its tokenizer, its stages, and after each its link to the other."""

    def __init__(
        self, tokenizer: Tokenizer, stages: Iterable[nn.Module], links: Iterable[nn.Module]
    ):
        super().__init__()
        self.tokenizer = tokenizer
        self.stages, self.links = nn.ModuleList(stages), nn.ModuleList(links)


class AsySplat(TokenNetwork):
    """The heavy geometry branch on coarse tokens, the light appearance branch on fine ones.

    Every component is a callable that builds a module, so that a configuration can replace it.

    Args:
        stage_ratios: r_s, the MLP ratio of each network stage.
        layers: the layer mix of every stage, such as "4m4s": counts and letters of `blocks`.
        blocks: letter -> component built from a StageShape.
        appearance_block: component built from the appearance branch's StageShape.
        appearance_layers: N_v.
        fine_to_coarse, coarse_to_fine: components of the bilateral link.
        fusion: component that makes the tokens that Gaussians are predicted from.
        patch_coarse, patch_fine: p_c, p_f; the first a multiple of the second.
        widths: see TokenNetwork.
    """

    def __init__(
        self,
        widths: Widths,
        stage_ratios: Sequence[int],
        layers: str,
        blocks: Mapping[str, Component],
        appearance_block: Component,
        appearance_layers: int,
        fine_to_coarse: Component,
        coarse_to_fine: Component,
        fusion: Component,
        head: Callable[..., GaussianHead],
        patch_coarse: int = 16,
        patch_fine: int = 8,
    ):
        super().__init__(widths, patch_coarse)
        if patch_coarse % patch_fine:
            raise InputError(
                f"model.patch_coarse={patch_coarse} is not a multiple of "
                f"model.patch_fine={patch_fine}: the paper uses 16 and 8."
            )
        self.appearance_layers = appearance_layers
        shapes = widths.stage_shapes(stage_ratios)
        fine = StageShape(widths.fine, widths.head_dim, APPEARANCE_MLP_RATIO)
        self.geometry = Branch(
            build_component(Tokenizer, patch_coarse, widths.stages[0]),
            stages=(
                build_component(Stage, previous.width, shape, layers, blocks)
                for previous, shape in zip([shapes[0], *shapes], shapes, strict=False)
            ),
            links=(build_component(fine_to_coarse, shape, fine) for shape in shapes),
        )
        self.appearance = Branch(
            build_component(Tokenizer, patch_fine, widths.fine),
            stages=(
                Layers(build_component(appearance_block, fine) for _ in range(appearance_layers))
                for _ in shapes
            ),
            links=(build_component(coarse_to_fine, shape, fine) for shape in shapes),
        )
        self.fusion = build_component(
            fusion, widths.stages[-1], widths.fine, patch_coarse // patch_fine
        )
        self.head = build_component(head, widths.stages[-1], patch_coarse, patch_fine)

    def tokens(self, pixels: Float[Tensor, "B V H W c"]) -> Float[Tensor, "B V h w d"]:
        coarse = self.geometry.tokenizer(pixels)  # [B, V, H / p_c, W / p_c, d_1]
        fine = self.appearance.tokenizer(pixels)  # [B, V, H / p_f, W / p_f, d_v]
        branches = zip(
            self.geometry.stages,
            self.appearance.stages,
            self.geometry.links,
            self.appearance.links,
            strict=True,
        )
        for geometry, appearance, fine_to_coarse, coarse_to_fine in branches:
            coarse, _ = geometry(coarse)  # [B, V, H / p_c, W / p_c, d_s]
            fine = appearance(fine)
            # Both links read the values from before the exchange (Eq. 3).
            coarse, fine = fine_to_coarse(coarse, fine), coarse_to_fine(fine, coarse)
        return self.fusion(coarse, fine)  # [B, V, H / p_f, W / p_f, d], or of p_c

    def geometry_ratio(self) -> float:
        """Return the fraction of parameters outside the appearance branch (paper: about 0.9)."""
        appearance = sum(p.numel() for p in self.appearance.parameters())
        return 1 - appearance / sum(p.numel() for p in self.parameters())

    def describe(self) -> str:
        """Return the number of parameters and the widths, in a line."""
        return (
            f"{super().describe()}, appearance {self.widths.fine} wide in "
            f"{self.appearance_layers} layers a stage"
        )


def build_asysplat(
    stage_widths: Sequence[int] = (192, 512, 896),
    fine_width: int = 256,
    head_dim: int = 64,
    appearance_layers: int = 2,
    width: float = 1.0,
    geometry_ratio: float | None = None,
    parameter_budget: float = 1.0,
    **components,
) -> AsySplat:
    """Build an AsySplat of the given widths (d_s, d_f and the head_dim) times `width`.

    With a `geometry_ratio` in (0, 1), choose the widths that give the geometry branch that fraction
    of the parameters. Their total is `parameter_budget` times that of the given widths.
    `components` are the other arguments of AsySplat.
    """
    if geometry_ratio is None and parameter_budget != 1:
        raise InputError(
            f"parameter_budget={parameter_budget} without a geometry_ratio: give both, or change "
            "width."
        )
    if not 0 <= appearance_layers <= MAX_LAYERS:
        raise InputError(
            f"model.appearance_layers={appearance_layers}: give a whole number from 0 to "
            f"{MAX_LAYERS}."
        )
    widths = Widths(tuple(stage_widths), fine_width, head_dim).scaled(width)

    def build(widths: Widths, layers: int) -> AsySplat:
        return AsySplat(widths, appearance_layers=layers, **components)

    if geometry_ratio is not None:
        with torch.device("meta"), torch.random.fork_rng(devices=()):
            widths, appearance_layers = solve_widths(
                build, widths, appearance_layers, geometry_ratio, parameter_budget
            )
    return build(widths, appearance_layers)
