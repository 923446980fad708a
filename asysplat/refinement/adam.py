"""Adam over a scene's Gaussians, of which a view shows some: the others stay as they are."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.adam import AdamSettings, Rows, adam_step


class VisibleAdam:
    """Adam (Kingma and Ba 2015) that takes a step with those rows of tensors that were seen.

    Each row of each tensor counts its own steps, from which its averages are corrected: a row that
    is seldom seen and a tensor that begins later start as on the first step.

    Args:
        parameters: tensors by name, contiguous, all with N rows, one for each Gaussian.
        betas: decay of the averages of a gradient and of its square, in [0, 1).
        eps: > 0, added to the root of the latter.

    Attributes:
        parameters: the tensors. A step changes them in place; `keep` and `append` put others in
            their place, as leaves that need a gradient if the old ones did.
        skipped: how many rows were seen so far and left out, a gradient being NaN or infinite.

    Raises:
        InputError: no tensors, tensors that are not so, betas or eps out of range.
    """

    def __init__(
        self,
        parameters: Mapping[str, Float[Tensor, "N ..."]],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ):
        if not all(0 <= beta < 1 for beta in betas) or not eps > 0:
            raise InputError(
                f"VisibleAdam got betas={betas} and eps={eps}: give betas in [0, 1) and eps > 0."
            )
        if not parameters:
            raise InputError("VisibleAdam got no parameters: give at least one tensor.")
        self.parameters = dict(parameters)
        self.skipped = 0
        self._settings = AdamSettings(*betas, eps)
        for name, tensor in self.parameters.items():
            rows = (self.num_rows, *tensor.shape[1:])
            if tensor.shape != rows or not (tensor.is_floating_point() and tensor.is_contiguous()):
                raise InputError(
                    f"VisibleAdam's {name} has shape {tuple(tensor.shape)}, type {tensor.dtype} "
                    f"and strides {tensor.stride()}: expected {self.num_rows} contiguous rows of "
                    "floating-point numbers."
                )
        self._state = {name: _zero_state(tensor) for name, tensor in self.parameters.items()}

    @property
    def num_rows(self) -> int:
        """How many Gaussians there are, N."""
        return len(next(iter(self.parameters.values())))

    @torch.no_grad()
    def step(
        self,
        gradients: Mapping[str, Float[Tensor, "N ..."] | None],
        rates: Mapping[str, float | Tensor],
        seen: Bool[Tensor, "N"],
    ) -> None:
        """Update the rows that were seen, but those with a gradient that is not finite.

        Args:
            gradients: of what is minimized, by name; those of tensors without a rate are not read.
            rates: >= 0, by name; a tensor without one, or with 0, is left out and costs nothing.
                Numbers of a row may have rates of their own, in a tensor that broadcasts to a row:
                [K, 1] for the K coefficients of `sh`.

            seen: which rows take a step.

        Raises:
            InputError: a name that is unknown, a rate that is below 0 or not finite, a gradient
                that is missing, anything of another shape.
        """
        if seen.shape != (self.num_rows,) or seen.dtype != torch.bool:
            raise InputError(
                f"VisibleAdam's seen has shape {tuple(seen.shape)}, type {seen.dtype}: expected "
                f"({self.num_rows},), bool."
            )
        tensors = []
        for name, rate in rates.items():
            of_row = self._rates_of_row(name, rate)
            if of_row.any():
                tensors.append(self._rows(name, gradients.get(name), of_row))
        if tensors:
            self.skipped += adam_step(tensors, seen.contiguous(), self._settings)

    @torch.no_grad()
    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Replace all rows by those of `index`, in its order; a row may be there several times."""
        for name, tensor in self.parameters.items():
            self.parameters[name] = _leaf(tensor[index], tensor)
            self._state[name] = {part: value[index] for part, value in self._state[name].items()}

    @torch.no_grad()
    def append(self, parameters: Mapping[str, Float[Tensor, "M ..."]]) -> None:
        """Add rows at the end of every tensor, without any steps yet.

        Raises:
            InputError: a tensor that is missing, unknown or has rows of another shape or number.
        """
        shapes = {name: tuple(tensor.shape) for name, tensor in parameters.items()}
        count = next(iter(shapes.values()), (0,))[0]
        expected = {name: (count, *tensor.shape[1:]) for name, tensor in self.parameters.items()}
        if shapes != expected:
            raise InputError(f"VisibleAdam.append got tensors {shapes}: expected {expected}.")
        for name, tensor in self.parameters.items():
            added = parameters[name].to(tensor)
            self.parameters[name] = _leaf(torch.cat((tensor, added)), tensor)
            self._state[name] = {
                part: torch.cat((self._state[name][part], value))
                for part, value in _zero_state(added).items()
            }

    def reset(self, rows: Int[Tensor, "M"] | Bool[Tensor, "N"]) -> None:
        """Forget the steps of rows: the next one is their first."""
        for state in self._state.values():
            for value in state.values():
                value[rows] = 0

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint needs besides the parameters; later steps change it."""
        return {
            f"{name}.{part}": value
            for name, state in self._state.items()
            for part, value in state.items()
        }

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a `state`, which is copied.

        Raises:
            InputError: it is that of other tensors.
        """
        shapes = {name: tuple(value.shape) for name, value in state.items()}
        expected = {name: tuple(value.shape) for name, value in self.state().items()}
        if shapes != expected:
            raise InputError(f"VisibleAdam.load got tensors {shapes}: expected {expected}.")
        for name, value in self.state().items():
            value.copy_(state[name])

    def _rates_of_row(self, name: str, rate: float | Tensor) -> Float[Tensor, "K"]:
        if name not in self.parameters:
            raise InputError(
                f"VisibleAdam got a rate for {name!r}: expected one of "
                f"{', '.join(self.parameters)}."
            )
        parameter = self.parameters[name]
        rates = torch.as_tensor(rate, dtype=parameter.dtype, device=parameter.device)
        if not (rates.isfinite() & (rates >= 0)).all():
            raise InputError(f"VisibleAdam got the rate {rate} for {name}: give numbers >= 0.")
        row = parameter.shape[1:]
        try:
            return rates.expand(row).reshape(-1)
        except RuntimeError:
            raise InputError(
                f"VisibleAdam got a rate of shape {tuple(rates.shape)} for {name}: expected "
                f"{tuple(row)}, or what broadcasts to it."
            ) from None

    def _rows(self, name: str, gradient: Tensor | None, rates: Float[Tensor, "K"]) -> Rows:
        parameter = self.parameters[name]
        if gradient is None or gradient.shape != parameter.shape:
            found = "is missing" if gradient is None else f"has shape {tuple(gradient.shape)}"
            raise InputError(
                f"VisibleAdam's gradient of {name} {found}: expected {tuple(parameter.shape)}."
            )
        state = self._state[name]
        gradient = gradient.to(parameter).contiguous()
        numbers = (parameter.detach(), gradient, state["mean"], state["square"])
        flat = (tensor.view(self.num_rows, len(rates)) for tensor in numbers)
        return Rows(*flat, state["steps"], rates)


def _zero_state(parameter: Tensor) -> dict[str, Tensor]:
    return {
        "mean": torch.zeros_like(parameter, requires_grad=False),
        "square": torch.zeros_like(parameter, requires_grad=False),
        "steps": torch.zeros(len(parameter), dtype=torch.int32, device=parameter.device),
    }


def _leaf(tensor: Tensor, like: Tensor) -> Tensor:
    return tensor.detach().requires_grad_(like.requires_grad)
