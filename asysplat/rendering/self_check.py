"""A small scene on which the renderer's kernels are compared with the reference.

SH of degree 1 and no depth, as in a reconstruction: its kernels need not be compiled again.
"""

import torch

from asysplat.kernels.self_check import KernelResults, relative_errors, seeded_normal
from asysplat.rendering.interface import RenderSettings
from asysplat.rendering.render import BACKENDS
from asysplat.scene import Cameras, Gaussians

NUM, HEIGHT, WIDTH = 60, 33, 45


def render(device: torch.device, backend: str) -> dict[str, float]:
    """Return the largest relative errors of images and of all gradients, against float64."""
    results = []
    for name, dtype in ((backend, torch.float32), ("reference", torch.float64)):
        sample = seeded_normal(device, dtype)
        means = torch.cat((sample(1, NUM, 2), sample(1, NUM, 1).abs() + 2), -1)
        scales, opacities = 0.1 * sample(1, NUM, 3).exp(), sample(1, NUM).sigmoid()
        leaves = (means, sample(1, NUM, 4), scales, opacities, 0.3 * sample(1, NUM, 4, 3))
        leaves = [leaf.requires_grad_() for leaf in leaves]
        lens = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
        poses = torch.eye(4).repeat(1, 2, 1, 1)
        poses[0, 1, 0, 3] = 0.2
        cameras = Cameras(lens.repeat(1, 2, 1, 1), poses, HEIGHT, WIDTH).to(device, dtype)
        out = BACKENDS[name](Gaussians(*leaves), cameras, RenderSettings(depth=None))
        images = [out.image, out.alpha]
        gradients = torch.autograd.grad(images, leaves, [sample(*i.shape).to(i) for i in images])
        results.append(KernelResults([image.detach() for image in images], gradients))
    return relative_errors(*results)
