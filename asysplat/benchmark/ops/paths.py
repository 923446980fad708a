"""One path of one operator: what it runs, and how wrong it is."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from asysplat.benchmark.ops.cases import Case, Tensors
from asysplat.benchmark.timing import Result, relative_l2, rise_gb, seconds_of
from asysplat.evaluation.cost import GB

KEPT = ("dt", "A", "D")  # inputs that are always fp32
Gradients = tuple[Tensor, dict[str, Tensor]]  # the output, and the gradients that inputs have


@dataclass(frozen=True)
class Path:
    """A backend of an operator."""

    case: Case
    backend: str
    inputs: Tensors  # of the operator, whose gradients are asked for
    weights: Tensor  # the gradient of the output, from a normal distribution

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.case.run(self.inputs, self.backend)

    def forward_backward(self) -> Gradients:
        if not self.case.differentiable:
            return self.forward(), {}
        output = self.case.run(self.inputs, self.backend)
        gradients = torch.autograd.grad(output, list(self.inputs.values()), self.weights)
        return output.detach(), dict(zip(self.inputs, gradients, strict=True))

    def passes(self) -> dict[str, Callable[[], object]]:
        if not self.case.differentiable:
            return {"forward": self.forward}
        return {"forward": self.forward, "forward_backward": self.forward_backward}

    def seconds(self) -> dict[str, float]:
        """Time each pass once."""
        return {name: seconds_of(run, self.weights.device) for name, run in self.passes().items()}

    def bytes_per_token(self) -> dict[str, float]:
        """Measure the peak memory of each pass."""
        device, tokens = self.weights.device, self.case.tokens
        return {name: GB * rise_gb(run, device) / tokens for name, run in self.passes().items()}

    def truth(self) -> Gradients:
        """Run the reference in float64 on the CPU, on inputs rounded as this path's are."""
        inputs = {n: t.detach().cpu().double().requires_grad_() for n, t in self.inputs.items()}
        weights = self.weights.cpu().double()
        return Path(self.case, "reference", inputs, weights).forward_backward()

    def errors(self, exact: Gradients) -> Result:
        """Compare the output and the gradient of each input with the exact ones, relative in L2."""
        output, gradients = self.forward_backward()
        wrong = {name: relative_l2(gradients[name], true) for name, true in exact[1].items()}
        forward = relative_l2(output, exact[0])
        measured_on = dict(self.case.sizes)
        return {"measured_on": measured_on, "forward": forward, "gradients": wrong or None}


def make_path(case: Case, backend: str, dtype: torch.dtype, device: torch.device) -> Path:
    """Make a path on the inputs of a case, in `dtype` but for those KEPT."""
    inputs = {
        name: tensor.to(device, torch.float32 if name in KEPT else dtype).requires_grad_()
        for name, tensor in case.tensors().items()
    }
    # The output has the shape and type of the first input.
    first = next(iter(inputs.values()))
    weights = torch.randn(first.shape, generator=torch.Generator().manual_seed(1))
    return Path(case, backend, inputs, weights.to(first))
