"""Gradients of the reference renderer against finite differences, an input at a time."""

import pytest
import torch

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

GAUSSIAN_FIELDS = ("means", "quats", "scales", "opacities", "sh")
INPUTS = (*GAUSSIAN_FIELDS, "cam_to_world", "intrinsics", "background")


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_equal_finite_differences(make_scene, name):
    # Wide Gaussians on few pixels, so that no alpha comes near a jump at 1/255 or .99.
    gaussians, cameras = make_scene(count=4, views=2, height=5, width=6)
    gaussians = Gaussians(
        gaussians.means * torch.tensor([0.2, 0.2, 1], dtype=torch.float64),
        gaussians.quats,
        gaussians.scales * 5,
        gaussians.opacities,
        gaussians.sh * 0.5,
    )
    single = [render(gaussians.keep(torch.arange(4) == i), cameras) for i in range(4)]
    alphas = torch.stack([out.alpha for out in single])
    assert alphas.min() > 1.1 / 255 and alphas.max() < 0.9
    assert (1 - alphas).prod(0).min() > 1e-3
    assert all((out.image / out.alpha[:, None]).min() > 0.05 for out in single)  # colors

    tensors = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "sh": gaussians.sh,
        "cam_to_world": cameras.cam_to_world,
        "intrinsics": cameras.intrinsics,
        "background": torch.rand(2, 3, dtype=torch.float64),
    }

    weights = torch.randn(3, 5, 6, dtype=torch.float64)

    def outputs(tensor):
        now = {**tensors, name: tensor}
        out = render(
            Gaussians(*(now[field] for field in GAUSSIAN_FIELDS)),
            Cameras(now["intrinsics"], now["cam_to_world"], cameras.height, cameras.width),
            now["background"],
        )
        return tuple(
            (image * weight).sum((-1, -2))
            for image, weight in zip((out.image, out.alpha, out.depth), weights, strict=True)
        )

    assert torch.autograd.gradcheck(outputs, tensors[name].clone().requires_grad_(), atol=1e-7)
