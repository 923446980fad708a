"""What both scans have in common: how one is called, and what torch sees of it.

A `Scan` checks its inputs and picks a form. "reference" and "chunked" are functions in torch; "cpu"
and "cuda" are modules of kernels. Torch sees the kernels as one operator, so that autograd,
torch.compile, autocast, the meta device and the FLOP counter take a scan as a whole.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.utils.flop_counter import register_flop_formula

from asysplat.errors import InputError
from asysplat.ops.dispatch import FAST, check_fast_backend, fast_backend, pick_backend
from asysplat.ops.precision import without_autocast


class ScanInputs(NamedTuple):
    """The inputs of a scan, or their gradients; shapes as in `ssd` and `selective_scan`."""

    x: Tensor
    dt: Tensor
    A: Tensor
    B: Tensor
    C: Tensor
    D: Tensor


class Kernels(Protocol):
    """The functions of a scan's modules cpu and cuda; x, B and C are of one float type."""

    def saved_state_shape(self, x: Tensor, B: Tensor) -> tuple[int, ...]:
        """Return the shape of what the backward pass needs besides the inputs, in fp32."""

    def forward(self, inputs: ScanInputs, reverse: bool, keep: bool) -> tuple[Tensor, Tensor]:
        """Return y and the saved state, whose sides are 0 unless `keep`."""

    def backward(
        self, grad_output: Tensor, inputs: ScanInputs, saved_state: Tensor, reverse: bool
    ) -> ScanInputs:
        """Return the gradients of the inputs."""


class Scan:
    """A scan over dimension 1, in fp32 at least.

    Args:
        name: "ssd" or "selective_scan".
        axes: of each input, such as "B L N"; those of x and N give all sizes.
        forms: the functions in torch, (x, dt, A, B, C, D) -> y, by name.
        load_kernels: "cpu" or "cuda" -> the module; called when it is first used, as it imports
            Numba's or Triton's compiler.
        count_flops: (shape of x, shape of B) -> FLOPs of the forward and of the backward pass.
    """

    def __init__(
        self,
        name: str,
        axes: Mapping[str, str],
        forms: Mapping[str, Callable[..., Tensor]],
        load_kernels: Callable[[str], Kernels],
        count_flops: Callable[[tuple[int, ...], tuple[int, ...]], tuple[int, int]],
    ):
        self.name, self.forms = name, forms
        self.axes = {key: value.split() for key, value in axes.items()}
        self.run_kernels = _register_operator(name, load_kernels, count_flops)

    def __call__(self, inputs: ScanInputs, backend: str, reverse: bool) -> Tensor:
        """Return y in the type of x, scanned from the last token to the first if `reverse`.

        Raises:
            InputError: an unknown backend, or one that cannot take these tensors; shapes or devices
                that do not go together; integers; no token.
        """
        self._check(inputs)
        if backend == "auto":
            backend = fast_backend(inputs.x, "chunked")
        with without_autocast(inputs.x):
            if backend in FAST:
                check_fast_backend(self.name, backend, inputs.x)
                return self._by_kernels(inputs, backend, reverse)
            backends = {"auto": None, **self.forms, **dict.fromkeys(FAST)}
            form = pick_backend(self.name, backends, backend)
            return _by_torch(inputs, form, reverse)

    def _by_kernels(self, inputs: ScanInputs, backend: str, reverse: bool) -> Tensor:
        keep = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
        y, _ = self.run_kernels(
            backend,
            x=inputs.x.contiguous(),
            dt=inputs.dt.float().contiguous(),
            A=inputs.A.float().contiguous(),
            B=inputs.B.to(inputs.x.dtype).contiguous(),
            C=inputs.C.to(inputs.x.dtype).contiguous(),
            D=inputs.D.float().contiguous(),
            reverse=reverse,
            keep=keep,
        )
        return y

    def _check(self, inputs: ScanInputs) -> None:
        x, B = inputs.x, inputs.B
        axes = self.axes["x"]
        if x.ndim != len(axes):
            raise InputError(
                f"{self.name}'s x has shape {tuple(x.shape)}: expected [{', '.join(axes)}]."
            )
        sizes = dict(zip(axes, x.shape, strict=True)) | {"N": B.shape[-1]}
        for (name, axes), tensor in zip(self.axes.items(), inputs, strict=True):
            shape = tuple(sizes[axis] for axis in axes)
            if tensor.shape != shape:
                raise InputError(
                    f"{self.name}'s {name} has shape {tuple(tensor.shape)}: expected {shape}, as x "
                    f"has shape {tuple(x.shape)} and B {tuple(B.shape)}."
                )
            if tensor.device != x.device:
                raise InputError(
                    f"{self.name}'s {name} is on {tensor.device} and x on {x.device}: move both to "
                    "one device."
                )
        for name, tensor in zip(inputs._fields, inputs, strict=True):
            if not tensor.is_floating_point():
                raise InputError(
                    f"{self.name}'s {name} is {tensor.dtype}: give floating-point numbers."
                )
        if x.numel() == 0 or B.numel() == 0:
            raise InputError(
                f"{self.name}'s x has shape {tuple(x.shape)} and B {tuple(B.shape)}: every side "
                "must be at least 1."
            )


def _by_torch(inputs: ScanInputs, form: Callable[..., Tensor], reverse: bool) -> Tensor:
    dtype = torch.promote_types(inputs.x.dtype, torch.float32)
    x, dt, A, B, C, D = (tensor.to(dtype) for tensor in inputs)
    if reverse:
        x, dt, B, C = (sequence.flip(1) for sequence in (x, dt, B, C))
    y = form(x, dt, A, B, C, D)
    return (y.flip(1) if reverse else y).to(inputs.x.dtype)


def _register_operator(
    name: str,
    load_kernels: Callable[[str], Kernels],
    count_flops: Callable[[tuple[int, ...], tuple[int, ...]], tuple[int, int]],
) -> Callable[..., tuple[Tensor, Tensor]]:
    """Make asysplat::<name> and its backward pass known to torch; see `Scan` for the arguments.

    Returns:
        (backend, x, dt, A, B, C, D, reverse, keep) -> (y, saved state).
    """
    tensors = "Tensor x, Tensor dt, Tensor A, Tensor B, Tensor C, Tensor D"

    @torch.library.custom_op(
        f"asysplat::{name}",
        mutates_args=(),
        schema=f"(str backend, {tensors}, bool reverse, bool keep) -> (Tensor, Tensor)",
    )
    def forward(backend, x, dt, A, B, C, D, reverse, keep):
        return load_kernels(backend).forward(ScanInputs(x, dt, A, B, C, D), reverse, keep)

    @torch.library.custom_op(
        f"asysplat::{name}_backward",
        mutates_args=(),
        schema=f"(str backend, Tensor grad_output, {tensors}, Tensor saved_state, bool reverse) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
    )
    def backward(backend, grad_output, x, dt, A, B, C, D, saved_state, reverse):
        inputs = ScanInputs(x, dt, A, B, C, D)
        return tuple(load_kernels(backend).backward(grad_output, inputs, saved_state, reverse))

    @forward.register_fake
    def _(backend, x, dt, A, B, C, D, reverse, keep):
        shape = load_kernels(backend).saved_state_shape(x, B)
        shape = shape if keep else (0,) * len(shape)
        return torch.empty_like(x), x.new_empty(shape, dtype=torch.float32)

    @backward.register_fake
    def _(backend, grad_output, x, dt, A, B, C, D, saved_state, reverse):
        return tuple(torch.empty_like(tensor) for tensor in (x, dt, A, B, C, D))

    def save(ctx, inputs, output):
        ctx.backend, *tensors, ctx.reverse, _ = inputs
        ctx.save_for_backward(*tensors, output[1])

    def gradients(ctx, grad_output, _):
        grads = backward(ctx.backend, grad_output, *ctx.saved_tensors, ctx.reverse)
        return None, *grads, None, None

    forward.register_autograd(gradients, setup_context=save)

    @register_flop_formula(getattr(torch.ops.asysplat, name))
    def _(backend, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[0]

    @register_flop_formula(getattr(torch.ops.asysplat, f"{name}_backward"))
    def _(backend, grad_shape, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[1]

    return forward
