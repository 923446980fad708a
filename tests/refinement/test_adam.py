"""Adam of the visible rows: as torch's for these, and no change of the others."""

import inspect

import numpy as np
import pytest
import torch

from asysplat.errors import InputError
from asysplat.refinement.adam import SelectiveAdam

NUM = 2100  # more than two blocks, and no whole number of vectors
# Rows of a number, of less than a vector, of a vector and of more.
SHAPES = {"means": (3,), "quats": (4,), "opacities": (), "sh": (16, 3), "other": (16,)}
RATES = {"means": 1e-2, "quats": 2e-3, "opacities": 5e-2, "sh": 1e-3, "other": 1e-2}
DTYPES = [torch.float32, torch.float64]  # of the kernel, and of the reference


def normal(num=NUM, dtype=torch.float32):
    return {name: torch.randn(num, *shape).to(dtype) for name, shape in SHAPES.items()}


def random_gradients(num=NUM, dtype=torch.float32):
    """Rows from 1e-6 to 1e4."""
    size = 10 ** torch.linspace(-6, 4, num)
    return {
        name: tensor * size.to(dtype).view(-1, *(1,) * (tensor.ndim - 1))
        for name, tensor in normal(num, dtype).items()
    }


def everything(optimizer):
    state = {f"{n}.{part}": t for n, parts in optimizer._state.items() for part, t in parts.items()}
    tensors = optimizer.parameters | state
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def torchs_adam(parameters, **options):
    """In float64, on copies of the parameters, which it also returns."""
    copies = {name: t.detach().double().clone().requires_grad_() for name, t in parameters.items()}
    groups = [{"params": [copies[name]], "lr": rate} for name, rate in RATES.items()]
    return torch.optim.Adam(groups, **{"eps": 1e-15, **options}), copies


def run_steps(optimizer, steps=5, dtype=torch.float32):
    """Random gradients for random rows."""
    for _ in range(steps):
        seen = torch.rand(optimizer.num_rows) < 0.6
        optimizer.step(random_gradients(optimizer.num_rows, dtype), RATES, seen)


@pytest.mark.parametrize(
    "dtype, runs, options",
    [
        (torch.float32, False, {}),
        (torch.float32, True, {"betas": (0.0, 0.5), "eps": 1e-3}),
        (torch.float64, False, {"betas": (0.0, 0.5), "eps": 1e-3}),
    ],
    ids=str,
)
def test_each_row_moves_as_with_its_own_adam_of_torch(dtype, runs, options):
    """Each group of rows has its own times; there may be whole vectors and blocks of a group."""
    ours = SelectiveAdam(normal(dtype=dtype), **options)
    groups = torch.arange(NUM) * 4 // NUM if runs else torch.randint(4, (NUM,))
    begin = everything(ours)
    theirs = {}
    for group in range(3):  # the last is never seen
        rows = {name: tensor[groups == group] for name, tensor in ours.parameters.items()}
        theirs[group] = torchs_adam(rows, **options)
    for step in range(30):
        gradients = random_gradients(dtype=dtype)
        seen = torch.zeros(NUM, dtype=torch.bool)
        for group, (adam, copies) in theirs.items():
            if step % (3 * group + 1) == 0:
                seen |= groups == group
                for name, tensor in copies.items():
                    tensor.grad = gradients[name][groups == group].double()
                adam.step()
        for name, gradient in gradients.items():
            gradient[~seen] = torch.nan  # is not looked at
            assert gradient.shape == ours.parameters[name].shape
        ours.step(gradients, RATES, seen)
    for name, tensor in ours.parameters.items():
        for group, (_, copies) in theirs.items():
            exact = copies[name].detach()
            assert group or runs or (exact - begin[name][groups == 0]).abs().max() > 5 * RATES[name]
            assert (tensor[groups == group] - exact).abs().max() <= 1e-6 * exact.abs().max()
    never = groups == 3
    for name, tensor in everything(ours).items():
        assert torch.equal(tensor[never], begin.get(name, torch.zeros_like(tensor))[never]), name
    assert ours.non_finite == 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_with_a_non_finite_gradient_are_not_updated(dtype):
    begin = normal(dtype=dtype)
    ours = SelectiveAdam({name: tensor.clone() for name, tensor in begin.items()})
    clean = SelectiveAdam(begin)
    gradients, seen = random_gradients(dtype=dtype), torch.rand(NUM) < 0.5
    seen[[0, 17, 18, NUM - 1]] = True
    seen[40] = False
    bad = {name: gradient.clone() for name, gradient in gradients.items()}
    bad["means"][0, 1] = torch.nan
    bad["opacities"][17] = torch.inf
    bad["sh"][17, 2, 1] = torch.nan  # a second time
    bad["sh"][18, 15, 2] = -torch.inf
    bad["quats"][NUM - 1, 3] = torch.nan
    bad["means"][40] = torch.nan  # was not seen
    ours.step(bad, RATES, seen)
    seen[[0, 17, 18, NUM - 1]] = False
    clean.step(gradients, RATES, seen)
    assert_same(everything(ours), everything(clean))
    assert (ours.non_finite, clean.non_finite) == (4, 0)
    assert type(ours.non_finite) is int


def test_a_gradient_with_an_infinite_square_stops_its_element_alone():
    optimizer = SelectiveAdam(normal())
    every = torch.ones(NUM, dtype=torch.bool)
    for step in range(3):
        gradients = random_gradients()
        gradients["sh"][7, 2, 1] = 1e30 if step == 0 else 1.0
        optimizer.step(gradients, RATES, every)
    for name, tensor in everything(optimizer).items():
        places = [[7, 2, 1]] if name == "sh.square" else []
        assert tensor.isinf().nonzero().tolist() == places
    assert all(tensor.isfinite().all() for tensor in optimizer.parameters.values())
    assert optimizer.non_finite == 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_tensor_without_a_rate_stays_and_may_start_later(dtype):
    ours = SelectiveAdam(normal(dtype=dtype))
    begin = everything(ours)
    every = torch.ones(NUM, dtype=torch.bool)
    without = {name: RATES[name] for name in ("means", "quats")} | {"opacities": 0.0}
    for _ in range(3):
        gradients = random_gradients(dtype=dtype)
        ours.step({name: gradients[name] for name in ("means", "quats")}, without, every)
    for name, tensor in everything(ours).items():
        rests = name.split(".")[0] in ("opacities", "sh", "other")
        assert torch.equal(tensor, begin[name]) == rests, name
    gradients = random_gradients(dtype=dtype)
    ours.step(gradients, RATES, every)
    # The first step of Adam goes as far as the rate says.
    moved = ours.parameters["sh"] - begin["sh"]
    expected = -RATES["sh"] * gradients["sh"].sign()
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_elements_of_a_row_may_have_their_own_rates(dtype):
    whole, rates = SelectiveAdam(normal(dtype=dtype)), np.full((16, 1), 5e-5)
    rates[0] = 1e-3
    sh = whole.parameters["sh"]
    parts = SelectiveAdam({"first": sh[:, :1].clone(), "rest": sh[:, 1:].clone()})
    for _ in range(4):
        seen, gradients = torch.rand(NUM) < 0.7, random_gradients(dtype=dtype)
        whole.step(gradients, {"sh": rates}, seen)
        split = {"first": gradients["sh"][:, :1], "rest": gradients["sh"][:, 1:]}
        parts.step(split, {"first": 1e-3, "rest": 5e-5}, seen)
    together = torch.cat(tuple(parts.parameters.values()), 1)
    torch.testing.assert_close(whole.parameters["sh"], together, rtol=1e-6, atol=1e-7)


def test_any_number_of_threads_gives_the_same_bits(threads):
    begin = normal(9000)
    for count in (1, 2, 3):
        threads(count)
        optimizer = SelectiveAdam({name: tensor.clone() for name, tensor in begin.items()})
        torch.manual_seed(1)
        run_steps(optimizer)
        first = everything(optimizer) if count == 1 else first
        assert_same(everything(optimizer), first)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_are_kept_copied_and_appended(dtype):
    optimizer, more = SelectiveAdam(normal(dtype=dtype)), normal(70, dtype)
    run_steps(optimizer, dtype=dtype)
    before, index = everything(optimizer), torch.tensor([5, 2, 2, NUM - 1, 0])
    optimizer.keep(index)
    assert_same(everything(optimizer), {name: tensor[index] for name, tensor in before.items()})
    run_steps(optimizer, dtype=dtype)
    before = everything(optimizer)
    optimizer.append(more)
    assert optimizer.num_rows == 75
    added = {name: tensor.new_zeros(70, *tensor.shape[1:]) for name, tensor in before.items()}
    expected = {name: torch.cat((before[name], t)) for name, t in (added | more).items()}
    assert_same(everything(optimizer), expected)
    alone, gradients = SelectiveAdam(more), random_gradients(70, dtype)
    for _ in range(2):
        rows = {name: torch.cat((t[:5], t)) for name, t in gradients.items()}
        optimizer.step(rows, RATES, torch.ones(75, dtype=torch.bool))
        alone.step(gradients, RATES, torch.ones(70, dtype=torch.bool))
    found = {name: tensor[5:] for name, tensor in everything(optimizer).items()}
    assert_same(found, everything(alone))
    optimizer.keep(torch.zeros(0, dtype=torch.int64))
    run_steps(optimizer, 1, dtype)
    assert optimizer.num_rows == 0


def test_gradients_that_are_missing_or_of_another_shape_change_nothing():
    optimizer = SelectiveAdam(normal(4))
    before, visible = everything(optimizer), torch.ones(4, dtype=torch.bool)
    for sentence, gradients in {
        "gradient of sh is missing": {"means": torch.ones(4, 3)},
        r"gradient of means has shape \(4, 4\): expected \(4, 3\)": {"means": torch.ones(4, 4)},
    }.items():
        with pytest.raises(InputError, match=sentence):
            optimizer.step(gradients, {"means": 1.0, "sh": 1.0}, visible)
    with pytest.raises(InputError, match=r"visible has shape \(5,\): expected \(4,\)"):
        inspect.unwrap(SelectiveAdam.step)(optimizer, normal(4), RATES, torch.ones(5) > 0)
    assert_same(everything(optimizer), before)
