"""The photometric loss of 3D Gaussian splatting: L1 and SSIM (Kerbl et al. 2023).

The backends "cpu" and "cuda" are modules of kernels, which compute the loss and its gradient at
once.
"""

from types import ModuleType

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.kernels.dispatch import (
    KERNEL_BACKENDS,
    check_device,
    check_float,
    check_kernel_backend,
    check_shape,
    choose_fastest,
    load_kernels,
    look_up_backend,
    without_autocast,
)
from asysplat.ops.image_loss.reference import SIZE, image_loss_reference, loss_weights


def image_loss(
    rendered: Float[Tensor, "*batch 3 H W"],
    target: Float[Tensor, "*batch 3 H W"],
    ssim_weight: float = 0.2,
    masks: Bool[Tensor, "*batch H W"] | None = None,
    backend: str = "auto",
) -> Float[Tensor, "*batch"]:
    """Compute (1 - w) mean|rendered - target| + w (1 - mean SSIM) of each image.

    SSIM (Wang et al. 2004) is that of `asysplat.evaluation.metrics.ssim`, but `rendered` is not
    clamped. Its 11x11 windows lie wholly inside the image, are weighted by a Gaussian of sigma 1.5,
    and have biased covariances. An image less than 11 pixels high or wide, which has no such
    window, has the loss of w = 0.

    Args:
        rendered: RGB; half precision is computed and returned in fp32.
        target: RGB in [0, 1], a constant for which no gradient is computed.
        ssim_weight: w in [0, 1]; at 0, SSIM is not computed.
        masks: False where a pixel is ignored: it takes the target's values, and so has no error and
            no gradient.
        backend: "cpu", "cuda", "reference" (torch, any device and float type), or "auto": that of
            `rendered`'s device, "reference" for float64.
    """
    _check(rendered, target, ssim_weight, masks)
    names = ("auto", "reference", *KERNEL_BACKENDS)
    look_up_backend("image_loss", dict.fromkeys(names), backend)
    if backend == "auto":
        backend = choose_fastest(rendered, "reference", "asysplat.ops.self_check:image_loss")
    elif backend != "reference":
        check_kernel_backend("image_loss", backend, rendered)
    dtype = torch.promote_types(rendered.dtype, torch.float32)
    rendered, target = rendered.to(dtype), target.detach().to(dtype)
    if masks is not None:
        rendered = torch.where(masks[..., None, :, :], rendered, target)
    if min(rendered.shape[-2:]) < SIZE:
        ssim_weight = 0.0
    if backend == "reference" or rendered.is_meta:
        with without_autocast(rendered):
            return image_loss_reference(rendered, target, ssim_weight)
    kernels = load_kernels("image_loss", backend)
    keep = torch.is_grad_enabled() and rendered.requires_grad
    return _ImageLoss.apply(kernels, rendered.contiguous(), target.contiguous(), ssim_weight, keep)


class _ImageLoss(torch.autograd.Function):
    """The loss as a function of torch, which saves only its gradient for the backward pass."""

    @staticmethod
    def forward(ctx, kernels: ModuleType, rendered, target, ssim_weight, keep):
        weights = loss_weights(*rendered.shape[-2:], ssim_weight)
        loss, gradient = kernels.compare_images(rendered, target, weights, keep)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_output):
        (gradient,) = ctx.saved_tensors
        return None, grad_output[..., None, None, None] * gradient, None, None, None


def _check(rendered: Tensor, target: Tensor, ssim_weight: float, masks: Tensor | None) -> None:
    if rendered.ndim < 3 or rendered.shape[-3] != 3 or rendered.numel() == 0:
        raise InputError(
            f"image_loss's rendered has shape {tuple(rendered.shape)}: expected [..., 3, H, W], "
            "every side at least 1."
        )
    reason = f", as rendered has shape {tuple(rendered.shape)}"
    mask_shape = rendered.shape[:-3] + rendered.shape[-2:]
    for name, tensor, shape in (("target", target, rendered.shape), ("masks", masks, mask_shape)):
        if tensor is not None:
            check_shape("image_loss", name, tensor, tuple(shape), reason)
            check_device("image_loss", name, tensor, "rendered", rendered)
    for name, tensor in {"rendered": rendered, "target": target}.items():
        check_float("image_loss", name, tensor, ", 8-bit images divided by 255")
    if not 0 <= ssim_weight <= 1:
        raise InputError(f"image_loss got ssim_weight={ssim_weight}: give a number from 0 to 1.")
