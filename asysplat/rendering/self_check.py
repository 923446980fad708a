"""A small scene on which the renderer's GPU kernels are compared with the reference.

SH of degree 1 and no depth, as in a reconstruction: its kernels need not be compiled again.
"""

import torch

from asysplat.kernels.self_check import relative_error, seeded_normal
from asysplat.rendering import reference
from asysplat.rendering.interface import RenderSettings
from asysplat.scene import Cameras, Gaussians

NUM, HEIGHT, WIDTH = 60, 33, 45


def render(device: torch.device) -> float:
    """Return the largest relative error of images and of all gradients, against float64."""
    from asysplat.rendering.cuda.draw import draw

    results = []
    for backend, dtype in ((draw, torch.float32), (reference.draw, torch.float64)):
        sample = seeded_normal(device, dtype)
        means = torch.cat((sample(1, NUM, 2), sample(1, NUM, 1).abs() + 2), -1)
        scales, opacities = 0.1 * sample(1, NUM, 3).exp(), sample(1, NUM).sigmoid()
        leaves = (means, sample(1, NUM, 4), scales, opacities, 0.3 * sample(1, NUM, 4, 3))
        leaves = [leaf.requires_grad_() for leaf in leaves]
        lens = torch.tensor([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
        poses = torch.eye(4).repeat(1, 2, 1, 1)
        poses[0, 1, 0, 3] = 0.2
        cameras = Cameras(lens.repeat(1, 2, 1, 1), poses, HEIGHT, WIDTH).to(device, dtype)
        out = backend(Gaussians(*leaves), cameras, RenderSettings(depth=None))
        images = [out.image, out.alpha]
        gradients = torch.autograd.grad(images, leaves, [sample(*i.shape).to(i) for i in images])
        results.append([*(image.detach() for image in images), *gradients])
    return relative_error(*results)
