"""One path of one operator: what it runs, and how wrong it is."""

from collections.abc import Callable

import torch
from torch import Tensor

from asysplat.benchmark.ops.cases import Case, Tensors, typed

Result = tuple[Tensor, dict[str, Tensor]]


class Path:
    """
    Args:
        case: whose inputs it is given.
        backend: of the operator.
        dtype: of the inputs that may be of half precision.
        device: where they are.
    """

    def __init__(self, case: Case, backend: str, dtype: torch.dtype, device: torch.device):
        self.case, self.backend, self.device = case, backend, device
        self.inputs = typed(case.tensors(), dtype, device)
        # The output has the shape and type of the first input.
        first = next(iter(self.inputs.values()))
        weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
        self.weights = weights.to(first)

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.case.run(self.inputs, self.backend)

    def forward_backward(self) -> Result:
        return _with_gradients(self.case, self.inputs, self.backend, self.weights)

    def passes(self) -> dict[str, Callable[[], object]]:
        return {"forward": self.forward, "forward_backward": self.forward_backward}

    def truth(self) -> Result:
        """The reference in float64 on the CPU, on inputs that are rounded as this path's are."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        return _with_gradients(self.case, inputs, "reference", self.weights.cpu().double())

    def errors(self, exact: Result) -> dict[str, float | dict[str, float]]:
        """Relative in L2, of the output and of the gradient of each input."""
        output, gradients = self.forward_backward()
        return {
            "forward": _relative(output, exact[0]),
            "gradients": {
                name: _relative(gradients[name], true) for name, true in exact[1].items()
            },
        }


def _with_gradients(case: Case, inputs: Tensors, backend: str, weights: Tensor) -> Result:
    output = case.run(inputs, backend)
    gradients = torch.autograd.grad(output, list(inputs.values()), weights)
    return output.detach(), dict(zip(inputs, gradients, strict=True))


def _relative(found: Tensor, true: Tensor) -> float:
    return ((found.cpu().double() - true).norm() / true.norm()).item()
