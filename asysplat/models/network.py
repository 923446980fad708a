"""What every network that turns views into Gaussians has in common."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.coverage import views_to_look_at
from asysplat.models.early_exit import EXACT, EarlyExit
from asysplat.models.head import GaussianHead
from asysplat.models.layers import Layers
from asysplat.models.prior import PRIOR_CHANNELS, Prior
from asysplat.models.shapes import Widths
from asysplat.models.tokenizer import PIXEL_CHANNELS, pixel_features
from asysplat.ops.precision import without_autocast
from asysplat.scene import Gaussians, Views


class Network(nn.Module, ABC):
    """Views -> Gaussians: checks sizes, takes any leading batch dimensions.

    Outside of training it leaves out what the thresholds of `skips` say, by default nothing;
    `skipped` has the shares that the last prediction left out: of the views that meet the network,
    of all layers of all views, of the Gaussians and of their SH bands.

    Args:
        widths: of the network.
        patch: image pixels along a side of its largest token.
        prior: views and the size of the head's grid -> what is known of the surfaces; or None.
    """

    head: GaussianHead
    dispensable: Collection[nn.Module] = ()  # layers that a scene with a sure prior can do without

    def __init__(self, widths: Widths, patch: int, prior: nn.Module | None):
        super().__init__()
        self.widths, self.patch, self.prior = widths, patch, prior
        self.early_exit: EarlyExit = EXACT
        self.skipped: dict[str, float] = {}

    def forward(self, views: Views) -> Gaussians:
        """Predict Gaussians [..., N] from views [..., V].

        Raises:
            InputError: image sides that are no multiples of `size_multiple`; skips for a network
                without a prior, or for several scenes at a time.
        """
        self.check_size(views.cameras.height, views.cameras.width)
        batch = views.images.shape[:-4]
        exact = self.training or self.early_exit == EXACT
        predict = self.predict if exact else self.predict_needed
        self.skipped.clear()
        gaussians = predict(with_one_batch_dimension(views))
        return gaussians.map(lambda field: field.reshape(*batch, *field.shape[1:]))

    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, N] from views [B, V]; N = V h w, of the head's grid."""
        pixels, prior = self.look(views)
        return self.head(self.tokens(pixels), views, prior)

    def predict_needed(self, views: Views) -> Gaussians:
        """Predict Gaussians [1, N] from views [1, V] as far as the scene needs it; see `skips`."""
        self.check_early_exit(self.early_exit)
        if len(views.images) != 1:
            raise InputError(
                f"the network's skips got {len(views.images)} scenes at a time: each has Gaussians "
                "of another number; give one, or set speed=exact."
            )
        skips, prior = self.early_exit, self.ask(views)
        looked, without = views_to_look_at(skips, prior, views.cameras), ()
        if skips.sure is not None and prior.confidence.mean() >= skips.sure:
            without = self.dispensable
        features = self._tokens_of(looked, views, prior, without) if looked else None
        gaussians = self.head(features, views, prior)
        if not looked:  # SH of higher degrees are all 0
            gaussians = replace(gaussians, sh=gaussians.sh[..., :1, :])
        if skips.faint is not None:
            seen = gaussians.opacities[0] >= skips.faint
            gaussians = gaussians.map(lambda field: field[:, seen])
        layers = sum(len(m) for m in self.modules() if isinstance(m, Layers))
        share = len(looked) / views.num_views
        self.skipped["views"] = 1 - share
        self.skipped["layers"] = 1 - share * (1 - len(without) / layers)
        self.skipped["gaussians"] = 1 - gaussians.num_gaussians / prior.confidence.numel()
        self.skipped["bands"] = 1 - gaussians.sh.shape[-2] / self.head.sh_bands
        return gaussians

    def _tokens_of(
        self, looked: list[int], views: Views, prior: Prior, without: Collection[nn.Module]
    ) -> Float[Tensor, "1 V h w d"]:
        """Return the tokens of these views; those of the others are 0, which corrects nothing."""
        known = prior.map(lambda each: each[:, looked])
        found = self.tokens(pixel_features(views.select(looked), known), without)
        tokens = found.new_zeros(1, views.num_views, *found.shape[2:])
        tokens[:, looked] = found
        return tokens

    @abstractmethod
    def tokens(
        self, pixels: Float[Tensor, "B V H W c"], without: Collection[nn.Module] = ()
    ) -> Float[Tensor, "B V h w d"]:
        """Turn pixels into the tokens that Gaussians are predicted from.

        Args:
            pixels: see `pixel_features`.
            without: layers to leave out.
        """

    @abstractmethod
    def geometry_share(self) -> float:
        """Return the share of parameters outside an appearance branch."""

    @property
    def pixel_channels(self) -> int:
        """The number of channels that a tokenizer sees of each pixel."""
        return PIXEL_CHANNELS + (0 if self.prior is None else PRIOR_CHANNELS)

    def look(self, views: Views) -> tuple[Float[Tensor, "B V H W c"], Prior | None]:
        """Return what the tokenizers see of every pixel, and the prior on the head's grid."""
        prior = None if self.prior is None else self.ask(views)
        return pixel_features(views, prior), prior

    def ask(self, views: Views) -> Prior:
        """Return what the prior knows, on the head's grid."""
        height, width = (s // self.head.stride for s in (views.cameras.height, views.cameras.width))
        with torch.no_grad(), without_autocast(views.images):
            return self.prior(views, (height, width))

    def describe(self) -> str:
        """Return the sizes and what they come to, in a line."""
        total = sum(p.numel() for p in self.parameters())
        stages = "/".join(map(str, self.widths.stages))
        return (
            f"{total / 1e6:.2f}M parameters, {self.geometry_share():.1%} of them for geometry; "
            f"stages {stages} wide, heads {self.widths.head_dim}"
        )

    def checkpoint_layers(self, checkpointing: bool) -> None:
        """Choose whether the backward pass computes each layer again; see `Layers`."""
        for module in self.modules():
            if isinstance(module, Layers):
                module.checkpointing = checkpointing

    def check_early_exit(self, skips: EarlyExit) -> None:
        """Raise InputError for skips that this network cannot take: they look at its prior."""
        if skips != EXACT and self.prior is None:
            raise InputError(
                "speed: this model has no prior, by which skips judge a scene: set speed=exact, or "
                "model/prior=plane_sweep."
            )

    @property
    def size_multiple(self) -> int:
        """The number that image sides must be multiples of: the largest patch."""
        return self.patch

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError unless both sides are multiples of `size_multiple`."""
        multiple = self.size_multiple
        if height % multiple or width % multiple:
            raise InputError(
                f"data.height x data.width is {height}x{width}, but this model takes multiples of "
                f"{multiple}, its patch: set {-(-height // multiple) * multiple}x"
                f"{-(-width // multiple) * multiple}, as the paper takes 540 to 544."
            )


def with_one_batch_dimension(views: Views) -> Views:
    """Flatten all leading batch dimensions into one: [..., V, ...] to [B, V, ...]."""
    dims = views.images.ndim - 4  # leading batch dimensions
    if dims == 1:
        return views
    if dims == 0:
        return views.map(lambda tensor: tensor[None])
    return views.map(lambda tensor: tensor.flatten(0, dims - 1))
