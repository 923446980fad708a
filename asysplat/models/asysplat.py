"""AsySplat: posed photographs to Gaussians through two asymmetric branches (paper, Sec. 3.2)."""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.layer_mix import parse_layer_mix
from asysplat.models.shapes import StageShape, Widths
from asysplat.models.tokenizer import Tokenizer, pixel_features
from asysplat.models.widths import solve_widths
from asysplat.scene import Gaussians, Views

APPEARANCE_MLP_RATIO = 4

Component = Callable[..., nn.Module]


class AsySplat(nn.Module):
    """The heavy geometry branch on coarse tokens, the light appearance branch on fine ones.

    Every component is a callable that builds a module, so that a configuration can name another.

    Args:
        widths: of both branches.
        stage_ratios: r_s, one a stage.
        layers: the layer mix of a stage, letters of `blocks`.
        blocks: letter -> component built from a StageShape.
        appearance_block: component built from the appearance branch's StageShape.
        appearance_layers: N_v.
        coarse_reads_fine, fine_reads_coarse: components of the bilateral link.
        source: component that merges the branches.
        head: component that decodes Gaussians.
        patch_coarse, patch_fine: p_c, p_f; the first a multiple of the second.

    Raises:
        InputError: an unusable layer mix, patch sizes that do not divide, unequal stage counts.
    """

    def __init__(
        self,
        widths: Widths,
        stage_ratios: Sequence[int],
        layers: str,
        blocks: Mapping[str, Component],
        appearance_block: Component,
        appearance_layers: int,
        coarse_reads_fine: Component,
        fine_reads_coarse: Component,
        source: Component,
        head: Component,
        patch_coarse: int = 16,
        patch_fine: int = 8,
    ):
        super().__init__()
        if patch_coarse % patch_fine:
            raise InputError(
                f"model.patch_coarse={patch_coarse} is not a multiple of "
                f"model.patch_fine={patch_fine}: the paper uses 16 and 8."
            )
        if len(stage_ratios) != len(widths.stages):
            raise InputError(
                f"model.stage_ratios has {len(stage_ratios)} entries for {len(widths.stages)} "
                "stages: give one MLP ratio a stage."
            )
        self.patch_coarse, self.patch_fine = patch_coarse, patch_fine
        mix = [blocks[letter] for letter in parse_layer_mix(layers, set(blocks))]
        shapes = [
            StageShape(width, widths.head, ratio)
            for width, ratio in zip(widths.stages, stage_ratios, strict=True)
        ]
        fine = StageShape(widths.fine, widths.head, APPEARANCE_MLP_RATIO)
        self.geometry = nn.ModuleDict(
            {
                "tokenizer": Tokenizer(patch_coarse, widths.stages[0]),
                "stages": nn.ModuleList(
                    GeometryStage(previous.width, shape, mix)
                    for previous, shape in zip([shapes[0], *shapes], shapes, strict=False)
                ),
                "links": nn.ModuleList(coarse_reads_fine(shape, fine) for shape in shapes),
            }
        )
        self.appearance = nn.ModuleDict(
            {
                "tokenizer": Tokenizer(patch_fine, widths.fine),
                "stages": nn.ModuleList(
                    nn.Sequential(*(appearance_block(fine) for _ in range(appearance_layers)))
                    for _ in shapes
                ),
                "links": nn.ModuleList(fine_reads_coarse(shape, fine) for shape in shapes),
            }
        )
        self.source = source(widths.stages[-1], widths.fine, patch_coarse // patch_fine)
        self.head = head(widths.stages[-1], patch_coarse, patch_fine)

    def forward(self, views: Views) -> Gaussians:
        """Views [..., V] with sides that are multiples of `size_multiple` -> Gaussians [..., N],
        N = V H W (p_f / p_c)^2."""
        self.check_size(views.cameras.height, views.cameras.width)
        batch = views.images.shape[:-4]
        views = with_one_batch_dimension(views)
        pixels = pixel_features(views)
        coarse = self.geometry["tokenizer"](pixels)
        fine = self.appearance["tokenizer"](pixels)
        branches = zip(
            self.geometry["stages"],
            self.appearance["stages"],
            self.geometry["links"],
            self.appearance["links"],
            strict=True,
        )
        for geometry, appearance, coarse_reads_fine, fine_reads_coarse in branches:
            coarse, fine = geometry(coarse), appearance(fine)
            # Both links read the values from before the exchange (Eq. 3).
            coarse, fine = coarse_reads_fine(coarse, fine), fine_reads_coarse(fine, coarse)
        gaussians = self.head(self.source(coarse, fine), views)
        return gaussians.map(lambda field: field.reshape(*batch, *field.shape[1:]))

    @property
    def size_multiple(self) -> int:
        """Image sides must be multiples of this: the coarse patch times the largest grid."""
        return self.patch_coarse * max(getattr(m, "grid", 1) for m in self.modules())

    def geometry_share(self) -> float:
        """Parameters outside the appearance branch over all parameters (paper: about 0.9)."""
        appearance = sum(p.numel() for p in self.appearance.parameters())
        return 1 - appearance / sum(p.numel() for p in self.parameters())

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError unless both sides are multiples of `size_multiple`."""
        multiple = self.size_multiple
        if height % multiple or width % multiple:
            raise InputError(
                f"data.height x data.width is {height}x{width}, but this model takes multiples of "
                f"{multiple} (coarse patch times grid): set {-(-height // multiple) * multiple}x"
                f"{-(-width // multiple) * multiple}, as the paper takes 540 to 544."
            )


class GeometryStage(nn.Module):
    """Stage s of the geometry branch: project to d_s, then the layer mix (Eq. 1)."""

    def __init__(self, previous_width: int, shape: StageShape, mix: list[Component]):
        super().__init__()
        same = previous_width == shape.width
        self.project = nn.Identity() if same else nn.Linear(previous_width, shape.width)
        self.layers = nn.Sequential(*(block(shape) for block in mix))

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w e"]:
        return self.layers(self.project(tokens))


def with_one_batch_dimension(views: Views) -> Views:
    """[..., V, ...] -> [B, V, ...]."""
    dims = views.images.ndim - 4  # leading batch dimensions
    if dims == 1:
        return views
    if dims == 0:
        return views.map(lambda tensor: tensor[None])
    return views.map(lambda tensor: tensor.flatten(0, dims - 1))


def build_asysplat(
    stage_widths: Sequence[int] = (192, 512, 896),
    fine_width: int = 256,
    head_width: int = 64,
    appearance_layers: int = 2,
    width: float = 1.0,
    geometry_ratio: float | None = None,
    **components,
) -> AsySplat:
    """An AsySplat of the paper's widths times `width`; with `geometry_ratio`, the same total is
    split between the branches so that the geometry branch holds that share of it.

    Args:
        stage_widths, fine_width, head_width: d_s, d_f and the head width at width 1.
        appearance_layers: N_v.
        width: multiplies the widths.
        geometry_ratio: between 0 and 1, or None for the paper's widths.
        components: the other arguments of AsySplat.

    Raises:
        InputError: a ratio that no widths reach.
    """
    widths = Widths(tuple(stage_widths), fine_width, head_width).scaled(width)

    def build(widths: Widths, layers: int) -> AsySplat:
        return AsySplat(widths, appearance_layers=layers, **components)

    if geometry_ratio is not None:
        with torch.device("meta"):
            widths, appearance_layers = solve_widths(
                build, widths, appearance_layers, geometry_ratio
            )
    return build(widths, appearance_layers)
