"""Adam that updates only the Gaussians visible in the current view."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.errors import InputError
from asysplat.kernels.host import copy_to
from asysplat.ops.adam import AdamSettings, Rows, adam_step


class SelectiveAdam:
    """Adam (Kingma and Ba 2015) that updates only the visible rows of its tensors.

    Each row of each tensor counts its own steps for the bias correction, so that a row that is
    seldom visible, or a tensor whose learning rate was 0, starts as on the first step.

    Its `parameters`, by name, are contiguous, with a row for each of N Gaussians. A step changes
    them in place; `keep` and `append` replace them. For betas and eps, see `AdamSettings`.
    """

    def __init__(
        self,
        parameters: Mapping[str, Float[Tensor, "N ..."]],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ):
        self.parameters = dict(parameters)
        for name, tensor in self.parameters.items():
            if tensor.dtype not in (torch.float32, torch.float64):
                raise InputError(
                    f"SelectiveAdam got {name} of type {tensor.dtype}: give float32 or float64; "
                    "half precision would lose small steps."
                )
        self._non_finite: int | Tensor = 0
        self._settings = AdamSettings(*betas, eps)
        self._state = {name: _zero_state(tensor) for name, tensor in self.parameters.items()}

    @property
    def non_finite(self) -> int:
        """Number of visible rows not updated so far, for a NaN or infinite gradient."""
        return int(self._non_finite)

    @property
    def num_rows(self) -> int:
        """Number of Gaussians, N."""
        return len(next(iter(self.parameters.values())))

    @torch.no_grad()
    def step(
        self,
        gradients: Mapping[str, Float[Tensor, "N ..."] | None],
        rates: Mapping[str, float | Float[np.ndarray, "..."]],
        visible: Bool[Tensor, "N"],
    ) -> None:
        """Update the visible rows, except those with a non-finite gradient.

        A tensor without a learning rate, or with 0, is not updated and needs no gradient. A rate
        that broadcasts to a row gives the rates of its elements: [K, 1] for the K coefficients of
        `sh`.
        """
        _expect("visible", visible, (self.num_rows,))
        row_rates = {}
        for name, rate in rates.items():
            numbers = np.broadcast_to(rate, self.parameters[name].shape[1:]).ravel()
            if numbers.any():
                row_rates[name] = numbers
        if not row_rates:
            return
        sizes = [len(numbers) for numbers in row_rates.values()]
        dtype = next(iter(self.parameters.values())).dtype
        together = np.concatenate([*row_rates.values()]).tolist()
        moved = copy_to(visible.device, together, dtype).split(sizes)
        tensors = []
        for name, numbers in zip(row_rates, moved, strict=True):
            parameter, state = self.parameters[name], self._state[name]
            gradient = _expect(f"gradient of {name}", gradients.get(name), parameter.shape)
            gradient = gradient.to(parameter).contiguous()
            fields = (parameter, gradient, state["mean"], state["square"])
            flat = (tensor.view(self.num_rows, len(numbers)) for tensor in fields)
            tensors.append(Rows(*flat, state["steps"], numbers.to(parameter.dtype)))
        self._non_finite += adam_step(tensors, visible.contiguous(), self._settings)

    @torch.no_grad()
    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Keep the rows of `index`, in its order; a row may be repeated."""
        for name, tensor in self.parameters.items():
            self.parameters[name] = tensor[index]
            self._state[name] = {part: value[index] for part, value in self._state[name].items()}

    def reset(self, name: str) -> None:
        """Give a tensor a new optimizer state."""
        self._state[name] = _zero_state(self.parameters[name])

    @torch.no_grad()
    def append(self, parameters: Mapping[str, Float[Tensor, "M ..."]]) -> None:
        """Add rows at the end of every tensor, with a new optimizer state."""
        for name, tensor in self.parameters.items():
            added = parameters[name].to(tensor)
            self.parameters[name] = torch.cat((tensor, added))
            self._state[name] = {
                part: torch.cat((self._state[name][part], value))
                for part, value in _zero_state(added).items()
            }


def _expect(name: str, tensor: Tensor | None, shape: tuple[int, ...]) -> Tensor:
    """Return a tensor of the shape, or raise InputError: the kernels have no bounds checks."""
    if tensor is None or tensor.shape != shape:
        problem = "is missing" if tensor is None else f"has shape {tuple(tensor.shape)}"
        raise InputError(f"SelectiveAdam's {name} {problem}: expected {tuple(shape)}.")
    return tensor


def _zero_state(parameter: Tensor) -> dict[str, Tensor]:
    return {
        "mean": torch.zeros_like(parameter),
        "square": torch.zeros_like(parameter),
        "steps": torch.zeros(len(parameter), dtype=torch.int32, device=parameter.device),
    }
