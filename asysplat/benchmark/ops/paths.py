"""One path of one operator: what it runs, and how wrong it is."""

from collections.abc import Callable

import torch
from torch import Tensor

from asysplat.benchmark.ops.cases import Case, Tensors
from asysplat.benchmark.timing import Result, rise_gb, seconds_of
from asysplat.evaluation.cost import GB

KEPT = ("dt", "A", "D")  # inputs that are always fp32
Gradients = tuple[Tensor, dict[str, Tensor]]  # the output, and the gradient of each input


class Path:
    """A backend of an operator on the inputs of a case, in `dtype` but for those KEPT."""

    def __init__(self, case: Case, backend: str, dtype: torch.dtype, device: torch.device):
        self.case, self.backend, self.device = case, backend, device
        self.inputs = {
            name: tensor.to(device, torch.float32 if name in KEPT else dtype).requires_grad_()
            for name, tensor in case.tensors().items()
        }
        # The output has the shape and type of the first input.
        first = next(iter(self.inputs.values()))
        weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
        self.weights = weights.to(first)

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.case.run(self.inputs, self.backend)

    def forward_backward(self) -> Gradients:
        return _with_gradients(self.case, self.inputs, self.backend, self.weights)

    def passes(self) -> dict[str, Callable[[], object]]:
        return {"forward": self.forward, "forward_backward": self.forward_backward}

    def seconds(self) -> dict[str, float]:
        """Time each pass once."""
        return {name: seconds_of(run, self.device) for name, run in self.passes().items()}

    def bytes_per_token(self) -> dict[str, float]:
        """Measure the peak memory of each pass."""
        runs, tokens = self.passes(), self.case.tokens
        return {name: GB * rise_gb(run, self.device) / tokens for name, run in runs.items()}

    def truth(self) -> Gradients:
        """Run the reference in float64 on the CPU, on inputs rounded as this path's are."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        return _with_gradients(self.case, inputs, "reference", self.weights.cpu().double())

    def errors(self, exact: Gradients) -> Result:
        """Compare the output and the gradient of each input with the exact ones, relative in L2."""
        output, gradients = self.forward_backward()
        worst = {name: _relative(gradients[name], true) for name, true in exact[1].items()}
        return {"forward": _relative(output, exact[0]), "gradients": worst}


def _with_gradients(case: Case, inputs: Tensors, backend: str, weights: Tensor) -> Gradients:
    output = case.run(inputs, backend)
    gradients = torch.autograd.grad(output, list(inputs.values()), weights)
    return output.detach(), dict(zip(inputs, gradients, strict=True))


def _relative(found: Tensor, true: Tensor) -> float:
    return ((found.cpu().double() - true).norm() / true.norm()).item()
