"""Words such as 4m4s: which blocks a geometry stage is made of, in order (paper, Table 6b)."""

import re

from asysplat.errors import InputError


def parse_layer_mix(word: str, letters: set[str]) -> list[str]:
    """One letter a layer: "4m4s" (or "4m+4s") -> m m m m s s s s.

    Args:
        word: counts and letters.
        letters: the letters that name a block.

    Raises:
        InputError: anything else, or no layer at all.
    """
    terms = re.findall(r"(\d+)([a-z])", word)
    layers = [letter for count, letter in terms for _ in range(int(count))]
    well_formed = "".join(f"{count}{letter}" for count, letter in terms) == word.replace("+", "")
    if not well_formed or not layers or not letters.issuperset(layers):
        raise InputError(
            f"model.layers={word!r}: expected counts and letters of {sorted(letters)}, "
            "such as 4m4s or 7m1t."
        )
    return layers
