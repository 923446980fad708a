"""Compute the scenes of a batch in parallel: in threads of a CPU, or by processes.

The operators of a scene of low resolution are too short to be divided among the cores.
The gradients of the scenes are averaged in the order of the scenes, so that the number of threads
changes no bit.
"""

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, reduce

import torch
from lightning.pytorch.strategies import ModelParallelStrategy
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from asysplat.data.datamodule import Batch
from asysplat.rendering import Rendering
from asysplat.scene import Gaussians

Terms = dict[str, Tensor]


@dataclass(frozen=True)
class Prediction:
    """Gaussians predicted from the input views, and their rendering at the target cameras.

    The Gaussians are those before pruning, which the terms of the loss are of, as in Long-LRM.
    """

    gaussians: Gaussians
    rendering: Rendering


class ParallelScenes:
    """Computes means over the scenes of a batch of the terms of `compute`, and their gradients.

    Batch norms normalize each scene by itself, as if it had its own process.
    """

    def __init__(self, net: nn.Module, compute: Callable[[Batch, nn.Module], Terms]):
        self.net, self.compute = net, compute
        self.copies: list[nn.Module] = []  # one a scene, with the parameters of `net`

    def __call__(self, batch: Batch) -> Terms:
        """Compute the mean of each term; the backward pass of "loss" gives the mean gradients."""
        scenes = split(batch)
        copies = self._copies(len(scenes))
        parameters = [p for p in self.net.parameters() if p.requires_grad]
        # Autocast is a setting of the calling thread alone.
        enabled, dtype = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")

        def differentiate(scene: Batch, net: nn.Module) -> tuple[Terms, tuple[Tensor, ...]]:
            # A cache would be shared by all threads.
            with torch.autocast("cpu", enabled=enabled, dtype=dtype, cache_enabled=False):
                terms = self.compute(scene, net)
            grads = torch.autograd.grad(terms["loss"], parameters, materialize_grads=True)
            return {name: term.detach() for name, term in terms.items()}, grads

        cores = torch.get_num_threads()
        workers = min(len(scenes), cores)
        results = list(_pool(workers, cores // workers).map(differentiate, scenes, copies))
        self._update_buffers(copies)
        terms, grads = zip(*results, strict=True)
        means = {name: torch.stack([row[name] for row in terms]).mean() for name in terms[0]}
        sums = [reduce(torch.add, gradients) for gradients in zip(*grads, strict=True)]
        means["loss"] = _WithGradients.apply(means["loss"], sums, len(scenes), *parameters)
        return means

    def _copies(self, count: int) -> list[nn.Module]:
        """Return networks that share the parameters and start from the same running means."""
        while len(self.copies) < count:
            shared = {id(parameter): parameter for parameter in self.net.parameters()}
            self.copies.append(copy.deepcopy(self.net, shared))
        copies, buffers = self.copies[:count], list(self.net.buffers())
        for net in copies:
            if net.training != self.net.training:
                net.train(self.net.training)
            for buffer, original in zip(net.buffers(), buffers, strict=True):
                buffer.copy_(original)
        return copies

    def _update_buffers(self, copies: list[nn.Module]) -> None:
        """Change the buffers by the mean of the copies' changes, counters as one copy did."""
        buffers = zip(self.net.buffers(), *(net.buffers() for net in copies), strict=True)
        for buffer, *changed in buffers:
            if buffer.is_floating_point():
                buffer += torch.stack([copied - buffer for copied in changed]).mean(0)
            else:
                buffer.copy_(changed[0])


class ShardedStrategy(ModelParallelStrategy):
    """Shards weights and batches among all processes of all nodes (FSDP2, also on CPUs)."""

    def __init__(self):
        # A checkpoint is one file with all weights, which a single process can read too.
        super().__init__(tensor_parallel_size=1, save_distributed_checkpoint=False)

    def setup_environment(self) -> None:
        # Lightning's "auto" would shard weights within a node only, by tensor parallelism.
        self._data_parallel_size = self.num_nodes * self.num_processes
        super().setup_environment()


def split(batch: Batch) -> list[Batch]:
    """Split a batch into batches of one scene."""
    scenes = []
    for index, scene in enumerate(batch["scene"]):
        views = {
            name: batch[name].map(lambda tensor, i=index: tensor[i, None])
            for name in ("inputs", "targets")
        }
        scenes.append({**batch, "scene": [scene], **views})
    return scenes


class _WithGradients(torch.autograd.Function):
    """Return a number unchanged; its gradients are `sums` / `count`."""

    @staticmethod
    def forward(ctx, number, sums, count, *parameters):
        ctx.sums, ctx.count = sums, count
        return number.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        factor = grad / ctx.count
        return None, None, None, *(total * factor for total in ctx.sums)


@cache
def _pool(workers: int, threads: int) -> ThreadPoolExecutor:
    """Return a pool of worker threads, each with `threads` for its operators."""
    return ThreadPoolExecutor(workers, "asysplat-scene", torch.set_num_threads, (threads,))


# A forked process starts without its parent's threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
