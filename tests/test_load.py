"""A model by the name of its file, and with overrides."""

import pytest

from asysplat import load
from asysplat.errors import InputError

TINY = ["width=0.125", "state_size=8", "model.layers=1m1s"]


def test_overrides_change_the_model_that_ships():
    assert (load().planes, load("shipped", ["model.planes=24"]).planes) == (64, 24)


def test_without_a_checkpoint_it_is_untrained():
    net = load(None, TINY)
    assert not net.training and sum(p.numel() for p in net.parameters()) < 4e6


def test_an_unknown_override_is_named():
    with pytest.raises(InputError, match="did you mean scale"):
        load("shipped", ["scael=gpu"])
