"""The LightningModule: it wires a network, the renderer and the losses, and nothing else."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from asysplat.evaluation.metrics import psnr
from asysplat.evaluation.static_cost import blank_views
from asysplat.models.network import Network
from asysplat.rendering import render
from asysplat.training.losses import ReconstructionLoss
from asysplat.training.outcome import Outcome


class Reconstruction(lightning.LightningModule):
    """Predict Gaussians from the input views, render the targets, compare.

    Args:
        net: views -> Gaussians; see `freeze_unread`.
        loss: of an outcome against its batch.
        learning_rate: its peak; linear warm-up, then a cosine to zero at `total_steps`.
        weight_decay: see `decaying`.
        betas: of AdamW.
        warmup_steps, total_steps: in optimizer steps.
        background: RGB behind the Gaussians.
        checkpoint_layers: compute each layer again in the backward pass, to save memory.
    """

    def __init__(
        self,
        net: Network,
        loss: ReconstructionLoss,
        learning_rate: float,
        weight_decay: float,
        betas: Sequence[float],
        warmup_steps: int,
        total_steps: int,
        background: Sequence[float],
        checkpoint_layers: bool = False,
    ):
        super().__init__()
        freeze_unread(net)
        net.checkpoint_layers(checkpoint_layers)
        self.net, self.loss = net, loss
        self.learning_rate, self.weight_decay, self.betas = learning_rate, weight_decay, betas
        self.warmup_steps, self.total_steps = warmup_steps, total_steps
        self.register_buffer("background", torch.tensor(background), persistent=False)

    def reconstruct(self, batch: dict[str, Any], depth: bool) -> Outcome:
        """Gaussians of the inputs and their rendering at the target cameras."""
        gaussians = self.net(batch["inputs"])
        targets = batch["targets"]
        rendering = render(
            gaussians, targets.cameras, self.background, depth=depth, masks=targets.masks
        )
        return Outcome(gaussians, rendering)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        outcome = self.reconstruct(batch, depth=self.loss.needs_depth)
        terms = self.loss(outcome, batch)
        size = len(batch["scene"])
        self.log_dict({f"train/{name}": term for name, term in terms.items()}, batch_size=size)
        self.log("train/learning_rate", self.lr_schedulers().get_last_lr()[0])
        targets = batch["targets"]
        quality = psnr(targets.masked(outcome.rendering.image.detach()), targets.images).mean()
        self.log("train/psnr", quality, prog_bar=True, batch_size=size)
        return terms["loss"]

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> Outcome:
        return self.reconstruct(batch, depth=True)

    def test_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> Outcome:
        return self.reconstruct(batch, depth=True)

    def configure_optimizers(self) -> dict[str, Any]:
        decay = set(decaying(self.net))
        trained = [p for p in self.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(
            [
                {
                    "params": [p for p in trained if p in decay],
                    "weight_decay": self.weight_decay,
                },
                {"params": [p for p in trained if p not in decay], "weight_decay": 0.0},
            ],
            lr=self.learning_rate,
            betas=tuple(self.betas),
            fused=True,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: self.learning_rate_factor(step)
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """By norm. Lightning's own refuses a fused optimizer under autocast, for the sake of
        fp16's loss scaling, which bf16 does without."""
        if gradient_clip_val:
            torch.nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val)

    def learning_rate_factor(self, step: int) -> float:
        """Linear warm-up to 1, then half a cosine to 0."""
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        progress = (step - self.warmup_steps) / max(1, self.total_steps - self.warmup_steps)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


WEIGHTED = (nn.Linear, nn.Conv1d, nn.Conv2d)


def decaying(net: nn.Module) -> list[nn.Parameter]:
    """The parameters that weight decay pulls to zero: the weights of products and convolutions.

    What is learned otherwise has a meaning away from zero: norms, biases, A, dt and D of the scans
    whatever their shape, tokens.
    """
    return [module.weight for module in net.modules() if isinstance(module, WEIGHTED)]


def freeze_unread(net: Network) -> None:
    """Let parameters on which no Gaussian depends take no gradient.

    Nothing would ever change them, but processes that train together wait for their gradients.
    They are there because the paper counts them: a link whose reader is not predicted from.
    """
    with torch.device("meta"):
        views = blank_views(2, net.size_multiple, net.size_multiple)
        state = {n: torch.empty(t.shape, dtype=t.dtype) for n, t in net.named_buffers()}
        leaves = {
            n: torch.empty(p.shape, dtype=p.dtype, requires_grad=True)
            for n, p in net.named_parameters()
        }
    gaussians = torch.func.functional_call(net, state | leaves, (views,))
    outputs = [getattr(gaussians, field.name).sum() for field in fields(gaussians)]
    grads = torch.autograd.grad(sum(outputs), list(leaves.values()), allow_unused=True)
    for parameter, grad in zip(net.parameters(), grads, strict=True):
        if grad is None:
            parameter.requires_grad_(False)
