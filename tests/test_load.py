"""A network by the name of its file, and with overrides that change no weights."""

import pytest
import torch

from asysplat import load
from asysplat.errors import InputError

TINY = ["width=0.125", "state_size=8", "model.layers=1m1s"]


@pytest.mark.medium
def test_overrides_change_the_network_that_ships():
    plain, other = load(), load("shipped", ["model.blocks.s.grid=1", "model.prior.planes=24"])
    assert (plain.prior.planes, other.prior.planes) == (64, 24)
    weights = other.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in plain.state_dict().items())


def test_without_a_checkpoint_it_is_untrained():
    net = load(None, TINY)
    assert not net.training and sum(p.numel() for p in net.parameters()) < 4e6


@pytest.mark.parametrize(
    ("overrides", "says"),
    [(["model.layer=8m"], "did you mean model.layers"), (["model.layers=8m"], "do not fit")],
)
def test_overrides_that_cannot_be_are_named(overrides, says):
    with pytest.raises(InputError, match=says):
        load("shipped", overrides)
