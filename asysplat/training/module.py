"""The LightningModule that trains a network through the renderer."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, Literal

import lightning
import torch
from torch import Tensor, nn
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.nn.modules.batchnorm import _BatchNorm
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from asysplat.evaluation.metrics import psnr
from asysplat.evaluation.static_cost import blank_views
from asysplat.models.layers import Layers
from asysplat.models.network import Network
from asysplat.rendering import render
from asysplat.training.losses.splatting import SplattingLoss
from asysplat.training.optimizers import JointOptimizer
from asysplat.training.parallel import Batch, ParallelScenes, Prediction


class SplattingModule(lightning.LightningModule):
    """Predict Gaussians from the input views, render the target views, compute the loss.

    Args:
        net: views -> Gaussians; see `freeze_unused`.
        optimizer: parameter groups -> optimizer; only `decaying` parameters have weight decay.
        matrix_optimizer: matrices -> optimizer, of `block_matrices`; None: as the others.
        schedule: optimizer -> its learning rates, one for each step.
        background: RGB in [0, 1] behind the Gaussians, or "inputs": what is behind an object in
            the input views, else their mean color; in training, in place of that mean, black or
            white, whichever is less like it, so that transparent Gaussians never lower the loss.
        checkpoint_layers: compute each layer again in the backward pass, to save memory.
        compile: run each layer as `torch.compile` makes it, for each size of images anew.
        views_at_once: targets of each scene that are rendered at a time; None: all. See `render`.
        drop_above: drop a step whose gradient's norm is above this multiple of the trainer's
            gradient_clip_val, as Long-LRM does; None: drop none.
    """

    def __init__(
        self,
        net: Network,
        loss: SplattingLoss,
        optimizer: Callable[[list[dict[str, Any]]], Optimizer],
        schedule: Callable[[Optimizer], LRScheduler],
        background: Sequence[float] | Literal["inputs"],
        matrix_optimizer: Callable[[list[nn.Parameter]], Optimizer] | None = None,
        checkpoint_layers: bool = False,
        compile: bool = False,
        views_at_once: int | None = None,
        drop_above: float | None = None,
    ):
        super().__init__()
        freeze_unused(net)
        net.checkpoint_layers(checkpoint_layers)
        if compile:
            for layer in _all_layers(net):
                layer.compile(dynamic=False)
        self.net, self.loss = net, loss
        self.optimizer, self.matrix_optimizer, self.schedule = optimizer, matrix_optimizer, schedule
        self.views_at_once, self.drop_above = views_at_once, drop_above
        self._parallel_scenes = ParallelScenes(net, self.scene_terms)
        self._accumulated = AccumulatedMetrics(net)
        fixed = None if background == "inputs" else torch.tensor(background, dtype=torch.float32)
        self.register_buffer("background", fixed, persistent=False)

    def configure_model(self) -> None:
        """Shard the parameters among the processes, layer by layer, if the strategy is FSDP's."""
        if self.device_mesh is None or isinstance(self.net, FSDPModule):
            return
        for block in (*_all_layers(self.net), self.net):
            fully_shard(block, mesh=self.device_mesh["data_parallel"])

    def forward(self, batch: Batch, depth: bool, net: nn.Module | None = None) -> Prediction:
        """Predict the Gaussians of the inputs, by `net` if given; render them at the targets."""
        net = self.net if net is None else net
        gaussians = net(batch["inputs"], prune=False)
        targets, background = batch["targets"], self.background_for(batch)
        options = {"masks": targets.masks, "views_at_once": self.views_at_once, "depth": depth}
        kept = net.select(gaussians) if batch.get("prune", True) else gaussians
        rendering = render(kept, targets.cameras, background, **options)
        return Prediction(gaussians, rendering)

    def background_for(self, batch: Batch) -> Tensor:
        """Return the background of the targets: [3], or [B, V, 3] if it depends on the inputs."""
        if self.background is not None:
            return self.background
        mean = batch["inputs"].mean_color()
        color = batch["inputs"].color_behind((mean < 0.5).to(mean) if self.training else mean)
        return color[:, None].expand(-1, batch["targets"].cameras.num_views, -1)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Compute the loss of a micro-batch; log the means of a step at its last micro-batch."""
        accumulated = self.trainer.accumulate_grad_batches
        if batch_idx % accumulated == 0:
            self._accumulated.start()
        terms = self.compute_terms(batch)
        self._accumulated.add(terms)
        if (batch_idx + 1) % accumulated == 0:
            means = self._accumulated.finish(self.trainer.strategy.reduce)
            self.log("train/psnr", means.pop("psnr"), prog_bar=True)
            self.log_dict({f"train/{name}": term for name, term in means.items()})
            self.log("train/learning_rate", self.lr_schedulers().get_last_lr()[0])
        return terms["loss"]

    def compute_terms(self, batch: Batch) -> dict[str, Tensor]:
        """Compute "loss", which has gradients, its terms and "psnr": means over the scenes."""
        views = {name: batch[name].decoded() for name in ("inputs", "targets")}
        batch = {**batch, **views}
        # In parallel on a CPU; copies of a network of sharded parameters could not gather them.
        on_cpu = self.device.type == "cpu" and self.device_mesh is None
        if on_cpu and len(batch["scene"]) > 1:
            return self._parallel_scenes(batch)
        return self.scene_terms(batch, self.net)

    def scene_terms(self, batch: Batch, net: nn.Module) -> dict[str, Tensor]:
        """Compute the terms of scenes that one network predicts."""
        prediction, targets = self(batch, depth=self.loss.needs_depth, net=net), batch["targets"]
        image = targets.masked(prediction.rendering.image.detach())
        return {**self.loss(prediction, batch), "psnr": psnr(image, targets.images).mean()}

    def validation_step(self, batch: Batch, batch_idx: int) -> Prediction:
        return self(batch, depth=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> Prediction:
        return self(batch, depth=True)

    def configure_optimizers(self) -> dict[str, Any]:
        decay = set(decaying(self.net))
        matrices = block_matrices(self.net) if self.matrix_optimizer else []
        trained = [p for p in self.parameters() if p.requires_grad and p not in set(matrices)]
        decayed = {"params": [p for p in trained if p in decay]}
        undecayed = {"params": [p for p in trained if p not in decay], "weight_decay": 0.0}
        optimizer = self.optimizer([decayed, undecayed])
        if self.matrix_optimizer and matrices:  # MVSplat has none
            optimizer = JointOptimizer(optimizer, self.matrix_optimizer(matrices))
        schedule = {"scheduler": self.schedule(optimizer), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        # Lightning refuses a fused optimizer under autocast, because of fp16's loss scaling, which
        # bf16 does not need.
        if not gradient_clip_val:
            return
        if gradient_clip_algorithm == "value":
            nn.utils.clip_grad_value_(self.parameters(), gradient_clip_val)
            return
        norm = nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val)
        if self.drop_above is not None and norm > self.drop_above * gradient_clip_val:
            optimizer.zero_grad(set_to_none=True)  # without gradients nothing is updated


def decaying(net: nn.Module) -> list[nn.Parameter]:
    """List the parameters that weight decay applies to, as in Long-LRM: weights and learned tokens.

    Zero is no neutral value of the others: norms, biases, and A, dt and D of the scans.
    """
    kinds = (nn.Linear, nn.Conv1d, nn.Conv2d)
    weights = [module.weight for module in net.modules() if isinstance(module, kinds)]
    tokens = getattr(net, "global_tokens", None)
    return weights if tokens is None else [*weights, tokens]


def _all_layers(net: nn.Module) -> list[nn.Module]:
    groups = (module for module in net.modules() if isinstance(module, Layers))
    return [layer for layers in groups for layer in layers]


def block_matrices(net: nn.Module) -> list[nn.Parameter]:
    """List the trained weight matrices of the blocks, which lie between tokenizer and head."""
    linear = [m for layer in _all_layers(net) for m in layer.modules() if isinstance(m, nn.Linear)]
    return [module.weight for module in linear if module.weight.requires_grad]


def freeze_unused(net: Network) -> None:
    """Turn off gradients that no Gaussian depends on: processes would wait for them forever."""
    with torch.device("meta"):
        views = blank_views(2, net.patch, net.patch)
        state = {n: torch.empty_like(t, device="meta") for n, t in net.named_buffers()}
        leaves = {n: torch.empty_like(p, device="meta") for n, p in net.named_parameters()}
        for leaf in leaves.values():
            leaf.requires_grad_()
    gaussians = torch.func.functional_call(net, state | leaves, (views,))
    outputs = [getattr(gaussians, field.name).sum() for field in fields(gaussians)]
    grads = torch.autograd.grad(sum(outputs), list(leaves.values()), allow_unused=True)
    for parameter, grad in zip(net.parameters(), grads, strict=True):
        if grad is None:
            parameter.requires_grad_(False)


class AccumulatedMetrics:
    """Averages the terms of the loss and the running means of batch norms over micro-batches."""

    def __init__(self, net: nn.Module):
        norms = [module for module in net.modules() if isinstance(module, _BatchNorm)]
        self.buffers = [b for norm in norms for b in (norm.running_mean, norm.running_var)]
        self.terms: list[dict[str, Tensor]] = []
        self.updated: list[list[Tensor]] = []

    def start(self) -> None:
        self.before = [buffer.clone() for buffer in self.buffers]
        self.terms, self.updated = [], []

    def add(self, terms: dict[str, Tensor]) -> None:
        self.terms.append({name: term.detach() for name, term in terms.items()})
        self.updated.append([buffer.clone() for buffer in self.buffers])
        self._set(self.before)

    def finish(self, reduce: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Update the running means; return the mean of every term; `reduce`: over processes."""
        updated = zip(*self.updated, strict=True)
        self._set([reduce(torch.stack(values).mean(0)) for values in updated])
        names = list(self.terms[0])
        means = torch.stack([torch.stack([terms[n] for terms in self.terms]).mean() for n in names])
        return dict(zip(names, reduce(means), strict=True))

    def _set(self, values: list[Tensor]) -> None:
        for buffer, value in zip(self.buffers, values, strict=True):
            # By .data, as a batch norm's pending backward pass has saved the buffer.
            buffer.data.copy_(value)
