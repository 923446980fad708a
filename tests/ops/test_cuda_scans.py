"""The Triton scans against the reference in float64: on a GPU, or in Triton's interpreter."""

import weakref
from collections import defaultdict
from importlib import import_module

import pytest
import torch
from compiler import DEVICE, INTERPRETED, kernel
from scans import NAMES, SCANS, make_arguments
from torch.utils._python_dispatch import TorchDispatchMode

from asysplat.errors import InputError

CHUNKS = {"ssd": 16, "selective_scan": 4} if INTERPRETED else {"ssd": 64, "selective_scan": 16}


def arguments(name, length, **options):
    return list(make_arguments(name, length, **{"head_dim": 16, "state": 16} | options))


def run(name, tensors, backend, reverse):
    """y, and the gradients of x, dt, A, B, C and D."""
    leaves = [tensor.detach().to(DEVICE).requires_grad_() for tensor in tensors]
    y = SCANS[name](*leaves, backend=backend, reverse=reverse)
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(y.shape, generator=generator).to(tensors[0].dtype)
    return [y.detach(), *torch.autograd.grad(y, leaves, weights.to(y))]


def check(name, tensors, reverse=False, tolerance=2e-6, backend="reference", dims=None):
    """Relative L2 errors; over all, or of each channel or head, along its place in `dims`."""
    exact = run(name, [tensor.double() for tensor in tensors], backend, reverse)
    got = run(name, tensors, "cuda", reverse)
    for part, a, b, like in zip(("y", *NAMES), got, exact, (tensors[0], *tensors), strict=True):
        assert a.dtype == like.dtype and a.isfinite().all(), part
        dim = None if dims is None else dims[part]
        if dim is not None:
            a, b = (t.movedim(dim, 0).flatten(1) if t.ndim > 1 else t[:, None] for t in (a, b))
        error = torch.linalg.vector_norm(a.double() - b, dim=-1 if dim is not None else None)
        scale = torch.linalg.vector_norm(b, dim=-1 if dim is not None else None)
        assert (error <= tolerance * scale).all(), (part, error / scale)


# The dimension of the heads or channels in each result.
OWN = {"y": 2, "x": 2, "dt": 2, "A": 0, "B": None, "C": None, "D": 0}


@kernel
@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("chunks, more", [(0, 1), (1, 0), (3, 5)])
def test_output_and_gradients_equal_the_reference(name, chunks, more, reverse):
    check(name, arguments(name, chunks * CHUNKS[name] + more), reverse)


@kernel
@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("length", [32, 77])
def test_a_selective_scan_in_segments_equals_the_reference(monkeypatch, length, reverse):
    scan = import_module("asysplat.ops.selective_scan.cuda")
    monkeypatch.setattr(scan, "SEGMENT", 1)
    monkeypatch.setattr(scan, "SHORTEST", 16)
    check("selective_scan", arguments("selective_scan", length), reverse)


def test_a_selective_scan_takes_memory_in_proportion_to_its_inputs(monkeypatch):
    """On the meta device, where no kernel runs: allocations without contents."""
    scan = import_module("asysplat.ops.selective_scan.cuda")
    for name in ("sum_chunk", "pass_states", "forward_chunk", "backward_chunk"):
        monkeypatch.setattr(scan, name, defaultdict(lambda: lambda *_, **__: None))
    peaks = []
    for length in (2**17, 2**18):
        x, B = (torch.empty(1, length, size, device="meta") for size in (512, 256))
        inputs = scan.ScanInputs(x, x, x.new_empty(512, 256), B, B, x.new_empty(512))
        with LiveNumbers() as numbers:
            scan.backward(x, inputs, scan.forward(inputs, reverse=False, keep=True)[1], False)
        peaks.append(numbers.peak)
    inputs_and_gradients = 2**17 * 2 * (512 + 256)
    assert peaks[1] - peaks[0] < 2 * inputs_and_gradients
    assert peaks[0] < 2 * inputs_and_gradients + 3 * scan.SEGMENT


class LiveNumbers(TorchDispatchMode):
    """Count the numbers of all tensors created within; `peak` is the most that lived at once."""

    def __init__(self):
        super().__init__()
        self.live = self.peak = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if isinstance(out, torch.Tensor) and not func.is_view and all(out is not a for a in args):
            self.live += out.numel()
            self.peak = max(self.peak, self.live)
            weakref.finalize(out, self.release, out.numel())
        return out

    def release(self, count):
        self.live -= count


@kernel
@pytest.mark.parametrize("name", SCANS)
def test_wide_heads_and_states(name):
    channels = 2 if name == "ssd" else 18  # more than a program's
    check(name, arguments(name, 17, batch=1, channels=channels, head_dim=64, state=64))
    if name == "ssd":  # of more than a program's columns
        check(name, arguments(name, 17, batch=1, channels=1, state=128))


@kernel
@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("dtype, tolerance", [(torch.bfloat16, 1e-2), (torch.float16, 1e-3)])
def test_half_precision_agrees_with_the_reference(name, dtype, tolerance):
    check(name, arguments(name, 17, dtype=dtype), tolerance=tolerance)


@kernel
@pytest.mark.parametrize("reverse", [False, True])
def test_states_stored_as_their_products_read_them_change_no_product(monkeypatch, reverse):
    scan = import_module("asysplat.ops.ssd.cuda")
    tensors = arguments("ssd", 3 * CHUNKS["ssd"] + 5, dtype=torch.bfloat16)
    half = run("ssd", tensors, "cuda", reverse)
    monkeypatch.setitem(scan.STATES, scan.BFLOAT16["DOT"], torch.float32)
    single = run("ssd", tensors, "cuda", reverse)
    for part, a, b in zip(("y", *NAMES), half, single, strict=True):
        # Gradients of decays also take a state times its gradient, in fp32.
        tolerance = {"dt": 1e-3, "A": 5e-3}.get(part, 0)
        assert (a - b).norm() <= tolerance * b.norm(), part


@kernel
@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("reverse", [False, True])
def test_all_small_and_all_large_steps_and_rates(name, reverse):
    tensors = arguments(name, CHUNKS[name] + 3, batch=1, channels=4)
    tensors[1] = torch.tensor([1e-8, 1e-8, 1e3, 1e3]).expand_as(tensors[1])
    rates = torch.tensor([-1e-4, -1e4, -1e-4, -1e4])
    tensors[2] = (rates if name == "ssd" else rates[:, None]).expand_as(tensors[2])
    check(name, tensors, reverse, dims=OWN)


@kernel
@pytest.mark.parametrize("name", SCANS)
def test_mixed_steps_and_rates(name):
    tensors = arguments(name, CHUNKS[name] + 3, channels=4)
    tensors[1] = 10 ** (torch.rand_like(tensors[1]) * 11 - 8)
    tensors[2] = -(10 ** (torch.rand_like(tensors[2]) * 8 - 4))
    check(name, tensors)
    tensors = arguments(name, CHUNKS[name] + 3, channels=2)
    tensors[1] *= 1e-3
    tensors[1][:, 1] = 1e12  # leaves small decays exact
    check(name, tensors)


@kernel
@pytest.mark.parametrize("name", SCANS)
def test_a_state_may_be_larger_than_half_precision_holds(name):
    x, dt, A, B, C, D = arguments(name, 17, batch=1, dtype=torch.float16)
    tensors = (x.abs(), dt, A, torch.full_like(B, 6e4), C * 1e-5, D)
    got = SCANS[name](*(tensor.to(DEVICE) for tensor in tensors), backend="cuda")
    exact = SCANS[name](*(tensor.double() for tensor in tensors), backend="reference")
    assert (got.cpu() - exact).norm() <= 1e-3 * exact.norm()


@kernel
@pytest.mark.parametrize(
    "name, sizes, message",
    [
        ("ssd", {"state": 24}, "state size of 24: expected a power of two from 16 to 256"),
        ("ssd", {"head_dim": 8}, "head_dim of 8: expected a power of two from 16 to 128"),
        ("selective_scan", {"state": 8}, "state size of 8: expected a power of two from 16 to 256"),
    ],
)
def test_sizes_that_kernels_cannot_take(name, sizes, message):
    with pytest.raises(InputError, match=message):
        run(name, arguments(name, 3, **sizes), "cuda", False)


@kernel
def test_auto_takes_sizes_that_kernels_cannot_take(monkeypatch):
    monkeypatch.setattr("asysplat.ops.scan.choose_fastest", lambda *arguments: "cuda")
    tensors = arguments("ssd", 3, head_dim=8)
    with pytest.warns(UserWarning, match="head_dim of 8: .* computed by 'chunked'"):
        got = run("ssd", tensors, "auto", False)
    assert all(map(torch.equal, got, run("ssd", tensors, "chunked", False)))


@pytest.mark.gpu
@pytest.mark.skipif(INTERPRETED, reason="too large")
@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("reverse", [False, True])
def test_long_sequences_equal_the_chunked_form_and_repeat(name, reverse):
    tensors = arguments(name, 10_007, channels=28, head_dim=64, state=256 if name == "ssd" else 16)
    half = [t.bfloat16() if i in (0, 3, 4) else t for i, t in enumerate(tensors)]
    check(name, tensors, reverse, backend="chunked")
    check(name, half, reverse, tolerance=1e-2, backend="chunked")
    first, again = (run(name, tensors, "cuda", reverse) for _ in range(2))
    assert all(map(torch.equal, first, again))
