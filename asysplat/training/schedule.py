"""The learning rate of each training step."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def cosine(optimizer: Optimizer, warmup_steps: int, total_steps: int) -> LambdaLR:
    """Return the schedule of a linear warm-up to the optimizer's rate, then a cosine to 0.

    The warm-up is part of the total; both are counted in optimizer steps.
    """

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        progress = (step - warmup_steps) / max(1, total_steps - warmup_steps)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))

    return LambdaLR(optimizer, factor)
