"""Gaussians as unconstrained parameters, and back."""

from dataclasses import fields as fields_of
from dataclasses import replace

import pytest
import torch

from asysplat.refinement.fields import Fields
from asysplat.refinement.settings import DEFAULT
from asysplat.scene import Gaussians

NAMES = [field.name for field in fields_of(Gaussians)]


@pytest.fixture
def gaussians(make_scene):
    return make_scene(count=12, degree=2, dtype=torch.float32)[0]


def units(gaussians):
    return torch.linspace(0.1, 3, gaussians.num_gaussians)


def assert_close(found, expected, error=1e-6):
    for name in NAMES:
        one, other = getattr(found, name), getattr(expected, name)
        torch.testing.assert_close(one, other, rtol=error, atol=error, msg=name)


def gradients_of(fields, fill=1.0):
    return {name: torch.full_like(tensor, fill) for name, tensor in fields.parameters.items()}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fields_give_back_gaussians_of_any_layout(gaussians, dtype):
    gaussians = replace(gaussians, sh=gaussians.sh.mT.contiguous().mT)
    gaussians.opacities[:3] = torch.tensor([1.0, 1 - 1e-6, 1e-6])
    gaussians.scales[3:5] = torch.tensor([1e-30, 1e30])[:, None]
    fields = Fields(gaussians.to(dtype), units(gaussians).to(dtype))
    assert not gaussians.sh.is_contiguous()
    assert_close(fields.gaussians().validate(), gaussians)
    assert len(fields) == 12 and torch.equal(fields.units, units(gaussians))


def test_fields_give_back_gaussians_in_half_precision(gaussians):
    half = gaussians.to(torch.bfloat16)
    half.opacities[0] = 1
    found = Fields(half, units(gaussians)).gaussians()
    assert_close(found.validate(), half.to(torch.float32))


@pytest.mark.parametrize("degree", [None, 0, 3])
def test_sh_are_cut_or_filled_with_0(gaussians, degree):
    found = Fields(gaussians, units(gaussians), degree).gaussians().sh
    count = 9 if degree is None else (degree + 1) ** 2
    assert found.shape == (12, count, 3)
    both = min(count, 9)
    assert torch.equal(found[:, :both], gaussians.sh[:, :both])
    assert (found[:, both:] == 0).all()


def test_the_first_step_is_as_long_as_the_rates(gaussians):
    """Adam's first step is the rate; a mean moves in its own unit."""
    rates = replace(
        DEFAULT.rates, means=0.5, quats=1e-3, scales=1e-2, opacities=0.1, sh=0.02, sh_rest=0.25
    )
    start = gaussians.map(torch.clone)
    fields = Fields(gaussians, units(gaussians))
    before = {name: tensor.clone() for name, tensor in fields.parameters.items()}
    assert fields.step(gradients_of(fields), rates, 0.5).all()
    assert_close(gaussians, start, 0)  # is copied
    moved = {name: before[name] - tensor for name, tensor in fields.parameters.items()}
    for name, rate in {"offsets": 0.5, "quats": 1e-3, "log_scales": 1e-2, "logits": 0.1}.items():
        expected = torch.full_like(moved[name], rate / 2)
        torch.testing.assert_close(moved[name], expected, rtol=1e-3, atol=1e-7, msg=name)
    expected = torch.full_like(moved["sh"], 0.25 * 0.01)
    expected[:, 0] = 0.01
    torch.testing.assert_close(moved["sh"], expected, rtol=1e-3, atol=1e-7)
    means = gaussians.means - 0.25 * units(gaussians)[:, None]
    torch.testing.assert_close(fields.gaussians().means, means, rtol=1e-4, atol=1e-6)


def test_invisible_rows_and_fields_without_a_rate_stay(gaussians):
    fields = Fields(gaussians, units(gaussians))
    gradients = gradients_of(fields)
    for gradient in gradients.values():
        gradient[::3] = 0
    gradients["sh"][1] = torch.nan
    rates = replace(DEFAULT.rates, quats=0.0)
    seen = fields.step(gradients, rates, 1.0)
    assert torch.equal(seen, torch.arange(12) % 3 > 0)
    assert fields.optimizer.non_finite == 1
    found = fields.gaussians()
    torch.testing.assert_close(found.quats, gaussians.quats)
    moved = (found.means != gaussians.means).any(-1)
    assert torch.equal(moved, seen & (torch.arange(12) != 1))


def test_leaves_have_gradients_and_parameters_none(gaussians):
    fields = Fields(gaussians, units(gaussians))
    leaves = fields.leaves()
    found = fields.gaussians(leaves)
    torch.stack([getattr(found, name).sum() for name in NAMES]).sum().backward()
    assert all((leaf.grad != 0).any() for leaf in leaves.values())
    torch.testing.assert_close(leaves["offsets"].grad, units(gaussians)[:, None].repeat(1, 3))
    assert not any(tensor.requires_grad for tensor in fields.parameters.values())


def test_rows_are_kept_and_added_with_a_unit_of_their_own(gaussians):
    fields = Fields(gaussians, units(gaussians))
    fields.step(gradients_of(fields), DEFAULT.rates, 1.0)
    before, index = fields.gaussians(), torch.tensor([7, 0, 7])
    fields.keep(index)
    assert len(fields) == 3
    before = before.map(lambda tensor: tensor[index])
    more = gaussians.keep(torch.arange(12) < 4)
    more = replace(more, sh=more.sh[:, :1])  # of fewer coefficients
    fields.append(more, torch.full((4,), 7.0))
    fields.append(gaussians.keep(torch.zeros(12, dtype=torch.bool)), torch.zeros(0))
    found, old = fields.gaussians(), torch.arange(7) < 3
    assert_close(found.keep(old), before, 0)
    assert torch.equal(fields.units, torch.cat((units(gaussians)[index], torch.full((4,), 7.0))))
    added = found.keep(~old)
    assert (added.sh[:, 1:] == 0).all()
    assert_close(replace(added, sh=added.sh[:, :1]), more)
    fields.step(gradients_of(fields), replace(DEFAULT.rates, means=1.0), 1.0)
    moved = added.means - fields.gaussians().means[3:]
    torch.testing.assert_close(moved, torch.full_like(moved, 7.0), rtol=1e-3, atol=0)
