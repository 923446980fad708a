"""The bias corrections of Adam, tabulated for kernels."""

import math
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from asysplat.ops.adam.reference import AdamSettings

ROUNDING = 2.0**-25  # number so small that 1 - ROUNDING is rounded to 1 in float32


@cache
def tabulate_corrections(settings: AdamSettings) -> Float[ndarray, "steps 2"]:
    """Tabulate 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) up to the step t where both are 1."""
    slowest = max(settings.beta1, settings.beta2, ROUNDING)
    t = np.arange(2 + math.ceil(math.log(ROUNDING) / math.log(slowest)))
    t[0] = 1  # unused: a row's first step is 1
    first, second = 1 - settings.beta1**t, 1 - settings.beta2**t
    return np.stack((1 / first, 1 / np.sqrt(second)), -1).astype(np.float32)
