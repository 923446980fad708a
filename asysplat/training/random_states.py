"""Save and restore the states of all random generators."""

import random
from typing import Any

import numpy as np
import torch

RandomStates = dict[str, Any]  # tensors and plain values: a checkpoint is read with weights_only


def random_states() -> RandomStates:
    """Return the states of Python's, NumPy's and torch's generators, of all GPUs too."""
    name, keys, *rest = np.random.get_state()
    return {
        "python": random.getstate(),
        "numpy": (name, torch.from_numpy(keys.astype(np.int64)), *rest),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all(),
    }


def set_random_states(states: RandomStates) -> None:
    """Restore the generators; those of GPUs only if their number is the same."""
    random.setstate(states["python"])
    name, keys, *rest = states["numpy"]
    np.random.set_state((name, keys.numpy().astype(np.uint32), *rest))
    torch.set_rng_state(states["torch"])
    if len(states["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(states["cuda"])
