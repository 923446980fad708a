"""What the words of several suites' options mean."""

from collections.abc import Sequence

import torch

from asysplat.errors import InputError

PRECISIONS = {"fp32": torch.float32, "bf16": torch.bfloat16}


def check_repeats(repeats: object) -> None:
    """Raise InputError unless it is a whole number from 1."""
    if not isinstance(repeats, int) or repeats < 1:
        raise InputError(f"repeats={repeats} cannot be: give a whole number from 1.")


def find_device(word: str) -> torch.device:
    """The device called `word`; "auto" is the GPU where there is one.

    Raises:
        InputError: another word, or a GPU that is not there.
    """
    if word == "auto":
        word = "cuda" if torch.cuda.is_available() else "cpu"
    if word not in ("cpu", "cuda"):
        raise InputError(f"device={word} is unknown: choose one of auto, cpu, cuda.")
    if word == "cuda" and not torch.cuda.is_available():
        raise InputError("device=cuda is not there: torch finds no GPU; take device=cpu.")
    return torch.device(word)


def find_precisions(option: str, words: Sequence[str]) -> dict[str, torch.dtype]:
    """Types by their names, in the order that was asked for.

    Args:
        option: that the words were given for.

    Raises:
        InputError: an unknown name, or none.
    """
    for word in list(words) or [None]:
        if word not in PRECISIONS:
            raise InputError(f"{option}={word} is unknown: choose some of {', '.join(PRECISIONS)}.")
    return {word: PRECISIONS[word] for word in words}
