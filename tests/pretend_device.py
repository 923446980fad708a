"""A device that is not there: tensors on a CPU that do not mix with those of the CPU.

What a GPU refuses is refused: tensors of both devices in one operator, numpy(), a generator of the
other device. It shows a forgotten `.to(device)` on a machine without one. Its name is that of
Graphcore's, which has no kernels of ours, or that of Apple's GPU, which has no float64 either.
"""

from contextlib import contextmanager
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE, APPLE, META = torch.device("ipu"), torch.device("mps"), torch.device("meta")
ATEN = torch.ops.aten
# Indices and masks of a CPU are taken on any device, and a copy moves numbers.
MIXING = {ATEN.index.Tensor, ATEN.index_put_.default, ATEN._index_put_impl_.default}
MIXING |= {ATEN.copy_.default, ATEN._to_copy.default}

_device = DEVICE


class Pretended(Tensor):
    """A tensor that says that it is on the pretended device."""

    @staticmethod
    def __new__(cls, inner):
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        # On meta, as autograd asks the driver of any other device.
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, dtype=inner.dtype, device="meta", **layout
        )
        tensor.inner, tensor.says = inner, _device
        return tensor

    @classmethod
    def __torch_dispatch__(cls, operator, types, args=(), kwargs=None):
        return _run(operator, args, kwargs or {})

    @property
    def device(self):
        return self.says

    def __getitem__(self, index):
        indices = index if isinstance(index, tuple) else (index,)
        lists = (torch.tensor(i) if isinstance(i, list) else i for i in indices)
        return super().__getitem__(tuple(lists))

    def new_tensor(self, data, **options):
        return Pretended(self.inner.new_tensor(data, **options))

    def tolist(self):
        return self.inner.tolist()

    def __format__(self, form):
        return format(self.inner, form)

    def __repr__(self):
        return f"Pretended({self.inner})"


class Generator(torch.Generator):
    """A generator that may say that it is on the pretended device."""

    def __new__(cls, device="cpu"):
        generator = super().__new__(cls, "cpu")
        generator.says = torch.device(device)
        return generator

    @property
    def device(self):
        return self.says


class _AsMeta(TorchFunctionMode):
    """Replaces the device, which torch may not be built for, by meta in every call."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.device:
            return function(*args, **kwargs)
        if function in (torch.tensor, torch.as_tensor) and kwargs.get("device") == _device:
            # Torch moves the numbers below what a mode sees.
            return function(*args, **kwargs | {"device": "cpu"}).to(META)
        generator = kwargs.get("generator")
        if generator is not None:
            like = next(
                (leaf.device for leaf in tree_leaves(args) if isinstance(leaf, Tensor)), None
            )
            if generator.device != (like or torch.device(kwargs.get("device", "cpu"))):
                raise RuntimeError(f"{function.__name__} got a generator of another device")
        args, kwargs = tree_map(
            lambda leaf: META if isinstance(leaf, torch.device) and leaf == _device else leaf,
            (args, kwargs),
        )
        return function(*args, **kwargs)


class _Pretend(TorchDispatchMode):
    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        return _run(operator, args, kwargs or {})


@contextmanager
def pretended_device(monkeypatch, device=DEVICE):
    """Let torch create tensors on `device`."""
    monkeypatch.setattr(torch, "Generator", Generator)
    monkeypatch.setitem(globals(), "_device", device)
    if device == DEVICE:  # activation checkpointing asks for the device's module
        monkeypatch.setattr(torch, device.type, SimpleNamespace(), raising=False)
    with _AsMeta(), _Pretend():
        yield device


def _run(operator, args, kwargs):
    """Run an operator on a CPU; its results are where its inputs, or `device`, say."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    wrapped = {id(x.inner): x for x in tensors if isinstance(x, Pretended)}
    on_cpu = [x for x in tensors if not isinstance(x, Pretended) and x.ndim]
    if any(x.is_meta for x in on_cpu):
        raise RuntimeError(f"{operator} got a tensor made below what a mode sees")
    if wrapped and on_cpu and operator not in MIXING:
        raise RuntimeError(f"{operator} got tensors on {_device} and on the CPU")
    pretended = isinstance(tensors[0], Pretended) if tensors else False
    pretended |= bool(wrapped) and operator not in MIXING
    if kwargs.get("device") is not None:
        pretended = torch.device(kwargs["device"]).type in ("meta", _device.type)
        kwargs = kwargs | {"device": torch.device("cpu")}
    args, kwargs = tree_map(
        lambda leaf: leaf.inner if isinstance(leaf, Pretended) else leaf, (args, kwargs)
    )
    out = operator(*args, **kwargs)
    if not pretended:
        return out

    def wrap(leaf):
        if not isinstance(leaf, Tensor):
            return leaf
        if _device == APPLE and leaf.dtype == torch.float64:
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype")  # torch's words
        return wrapped[id(leaf)] if id(leaf) in wrapped else Pretended(leaf)

    return tree_map(wrap, out)
