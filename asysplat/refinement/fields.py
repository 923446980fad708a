"""A scene's Gaussians as unconstrained numbers that an optimizer moves."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.refinement.adam import VisibleAdam
from asysplat.refinement.settings import Rates
from asysplat.scene import Gaussians

Numbers = dict[str, Tensor]


class Fields:
    """Offsets of the means, quaternions, logarithms of scales, logits of opacities and SH.

    Offsets are in a unit of each Gaussian's own, so that near and far ones move alike.

    Args:
        gaussians: [N], to start from.
        units: length of an offset of 1.
        sh_degree: of the SH; coefficients that are missing start at 0.
    """

    def __init__(
        self, gaussians: Gaussians, units: Float[Tensor, "N"], sh_degree: int | None = None
    ):
        self.count = gaussians.sh.shape[1] if sh_degree is None else (sh_degree + 1) ** 2
        self._origins, numbers = self._unconstrained(gaussians)
        self._units = units[:, None].to(self._origins)
        self._adam = VisibleAdam(numbers)

    def __len__(self) -> int:
        return len(self._origins)

    @property
    def numbers(self) -> Numbers:
        """The tensors that the optimizer moves, by name."""
        return self._adam.parameters

    @property
    def units(self) -> Float[Tensor, "N"]:
        """The length of an offset of 1."""
        return self._units[:, 0]

    @property
    def skipped(self) -> int:
        """How many rows were left out, a gradient being NaN or infinite."""
        return self._adam.skipped

    def leaves(self) -> Numbers:
        """Return the tensors as leaves of a graph."""
        return {name: tensor.detach().requires_grad_() for name, tensor in self.numbers.items()}

    def gaussians(self, numbers: Mapping[str, Tensor] | None = None) -> Gaussians:
        """Return the Gaussians of `numbers`, or as they are, differentiable in them."""
        numbers = self.numbers if numbers is None else numbers
        return Gaussians(
            means=torch.addcmul(self._origins, self._units, numbers["offsets"]),
            quats=numbers["quats"],
            scales=numbers["log_scales"].exp(),
            opacities=numbers["logits"].sigmoid(),
            sh=numbers["sh"],
        )

    def step(self, gradients: Numbers, rates: Rates, factor: float) -> Bool[Tensor, "N"]:
        """Move the Gaussians that were seen against their gradients; return which were.

        Args:
            gradients: of the numbers.
            rates: see `Rates`.
            factor: of all rates.
        """
        seen = gradients["logits"] != 0
        bands = torch.full((self.count, 1), rates.sh * rates.higher)
        bands[0] = rates.sh
        self._adam.step(
            gradients,
            {
                "offsets": rates.means * factor,
                "quats": rates.quats * factor,
                "log_scales": rates.scales * factor,
                "logits": rates.opacities * factor,
                "sh": bands * factor,
            },
            seen,
        )
        return seen

    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Keep the rows of `index`."""
        self._adam.keep(index)
        self._origins, self._units = self._origins[index], self._units[index]

    def append(self, gaussians: Gaussians, units: Float[Tensor, "M"]) -> None:
        """Add Gaussians, without steps yet."""
        origins, numbers = self._unconstrained(gaussians)
        self._adam.append(numbers)
        self._origins = torch.cat((self._origins, origins))
        self._units = torch.cat((self._units, units[:, None].to(self._units)))

    def _unconstrained(self, gaussians: Gaussians) -> tuple[Float[Tensor, "N 3"], Numbers]:
        """Return where the offsets begin, and the numbers: copies in float32."""
        options = {"dtype": torch.float32, "memory_format": torch.contiguous_format, "copy": True}
        gaussians = gaussians.map(lambda field: field.detach().to(**options))
        sh = gaussians.sh[:, : self.count]
        missing = sh.new_zeros(len(sh), self.count - sh.shape[1], 3)
        return gaussians.means, {
            "offsets": torch.zeros_like(gaussians.means),
            "quats": gaussians.quats,
            "log_scales": gaussians.scales.log(),
            "logits": gaussians.opacities.clamp(1e-6, 1 - 1e-6).logit(),
            "sh": torch.cat((sh, missing), dim=1),
        }
