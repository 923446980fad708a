"""Split the Gaussians whose centers the images pull most: a densification in thirty lines.

python examples/densify.py
"""

import torch
import torch.nn.functional as F

from asysplat import Gaussians, Views, render
from asysplat.data import ProceduralScene
from asysplat.interrupts import handle_signals

RATES = (2e-3, 1e-2, 1e-2, 5e-2, 1e-2)  # rates of means, quats, log scales, logits and SH
STEPS = 30


def densify(views: Views, parameters: list[torch.Tensor], split: float) -> list[torch.Tensor]:
    """Fit Gaussians for STEPS steps, then split a fraction of them in two."""
    parameters = [tensor.detach().requires_grad_() for tensor in parameters]
    groups = [{"params": [p], "lr": rate} for p, rate in zip(parameters, RATES, strict=True)]
    optimizer, pull = torch.optim.Adam(groups), torch.zeros(len(parameters[0]))
    for _ in range(STEPS):
        means, quats, log_scales, logits, sh = parameters
        gaussians = Gaussians(means, quats, log_scales.exp(), logits.sigmoid(), sh)
        out = render(gaussians, views.cameras, projections=True)
        loss = F.mse_loss(out.image, views.images)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        pull += out.projections.means2d.grad.norm(dim=-1).sum(0)  # over all views
    print(f"{len(pull):,} Gaussians, {-10 * loss.log10():.2f} dB")
    chosen = pull.topk(int(split * len(pull))).indices
    shift = log_scales.exp() * torch.randn_like(means)
    for tensor, change in ((means, shift), (log_scales, torch.full_like(means, -0.5))):
        tensor.data[chosen] += change[chosen]
    halves = [tensor[chosen] for tensor in parameters]
    halves[0] = halves[0] - 2 * shift[chosen]
    return [torch.cat(pair) for pair in zip(parameters, halves, strict=True)]


def main(rounds: int = 6) -> None:
    views = ProceduralScene(seed=5, height=64, width=64).views(range(0, 24, 4))
    num, generator = 400, torch.Generator().manual_seed(0)
    view, pixel = torch.randint(6, (num,), generator=generator), torch.rand(num, 2) * 64
    cameras, (x, y) = views.cameras, pixel.long().unbind(1)
    offsets = views.depths[view, y, x, None] * cameras.pixel_directions()[view, y, x]
    poses = cameras.cam_to_world[view]
    parameters = [
        (poses[:, :3, :3] @ offsets[..., None])[..., 0] + poses[:, :3, 3],
        torch.tensor([1.0, 0, 0, 0]).repeat(num, 1),
        torch.full((num, 3), -2.5),
        torch.zeros(num),
        torch.zeros(num, 1, 3),
    ]
    for _ in range(rounds):
        parameters = densify(views, parameters, split=0.5)


if __name__ == "__main__":
    handle_signals()
    main()
