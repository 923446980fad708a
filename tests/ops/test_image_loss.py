"""The image loss: its formula, the kernels against it in float64, and invariances."""

import inspect

import pytest
import torch
from compiler import DEVICE, INTERPRETED

from asysplat.errors import InputError
from asysplat.evaluation.metrics import ssim
from asysplat.ops import image_loss

FAST = [
    pytest.param("cpu", marks=pytest.mark.skipif(INTERPRETED, reason="for cuda alone")),
    pytest.param("cuda", marks=[] if INTERPRETED else pytest.mark.gpu),
]
fast = pytest.mark.parametrize("backend", FAST)
DEVICES = {"auto": "cpu", "reference": "cpu", "cpu": "cpu", "cuda": DEVICE}
# Around the window's size, a vector's, and a band's or a program's.
SIZES = [(11, 11), (17, 130), (12, 29)]
if not INTERPRETED:
    SIZES += [(26, 16), (64, 17), (139, 33), (20, 300), (75, 270)]
SMALL = [(1, 1), (10, 30), (70, 9)]
VALUE, GRADIENT = 1e-6, 1e-5  # of the kernel against float64, the latter relative in L2


def images(kind, *shape):
    """A rendering and its target [*shape]: noise, alike, or bright, alike and nearly flat."""
    target = torch.rand(shape)
    if kind == "noise":
        return torch.rand(shape), target
    if kind == "flat":
        target = 0.95 + 0.002 * target
    return target + 0.02 * torch.randn(shape), target


def both_ways(rendered, target, *args, backend="auto", dtype=torch.float32, masks=None):
    """The loss of each image by a backend, and the gradient of their sum."""
    device = DEVICES[backend]
    rendered = rendered.to(device, dtype, copy=True).requires_grad_()
    masks = None if masks is None else masks.to(device)
    loss = image_loss(rendered, target.to(rendered), *args, masks=masks, backend=backend)
    return loss.detach().cpu(), torch.autograd.grad(loss.sum(), rendered)[0].cpu()


def assert_close(got, exact, gradient=GRADIENT):
    (loss, grad), (exact_loss, exact_grad) = got, exact
    assert loss.dtype == grad.dtype == torch.float32
    assert loss.shape == exact_loss.shape and grad.shape == exact_grad.shape
    assert (loss - exact_loss).abs().max() <= VALUE
    assert (grad - exact_grad).norm() <= gradient * exact_grad.norm()


@fast
@pytest.mark.parametrize("kind", ["noise", "alike", "flat"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_the_kernel_computes_the_reference(size, kind, backend):
    pair = images(kind, 2, 3, *size)
    assert_close(both_ways(*pair, backend=backend), both_ways(*pair, dtype=torch.float64))


@pytest.mark.parametrize("backend", ["reference", *FAST])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_loss_is_l1_and_the_published_ssim(weight, backend):
    rendered, target = images("alike", 2, 2, 3, 16, 31)
    rendered = rendered.clamp(0, 1)
    l1, similarity = (rendered - target).abs().mean((-3, -2, -1)), ssim(rendered, target)
    expected = (1 - weight) * l1 + weight * (1 - similarity)
    pair = (image.to(DEVICES[backend]) for image in (rendered, target))
    loss = image_loss(*pair, weight, backend=backend)
    torch.testing.assert_close(loss.cpu(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_gradient_of_the_reference(weight):
    rendered, target = (image.double() for image in images("alike", 3, 12, 13))
    rendered.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: image_loss(x, target, weight), rendered, fast_mode=True
    )


@fast
@pytest.mark.parametrize("size", SMALL, ids=str)
def test_an_image_without_a_window_has_the_loss_l1(size, backend):
    rendered, target = images("noise", 3, *size)
    for weight in (0.0, 0.2, 1.0):
        loss, grad = both_ways(rendered, target, weight, backend=backend)
        torch.testing.assert_close(loss, (rendered - target).abs().mean())
        torch.testing.assert_close(grad, (rendered - target).sign() / rendered.numel())
        assert_close((loss, grad), both_ways(rendered, target, weight, dtype=torch.float64))


@fast
@pytest.mark.parametrize("size", [(19, 30), (7, 5)], ids=str)
def test_identical_images_have_no_loss_and_no_gradient(size, backend):
    _, target = images("flat", 2, 3, *size)
    target[1] = 0.7
    loss, grad = both_ways(target, target, backend=backend)
    assert (loss == 0).all() and (grad == 0).all()


@fast
def test_one_color_against_another(backend):
    pair = torch.full((3, 12, 20), 0.3), torch.full((3, 12, 20), 0.8)
    exact = both_ways(*pair, dtype=torch.float64)
    # The windows' contrasts, which are 0, make large terms that cancel.
    assert_close(both_ways(*pair, backend=backend), exact, gradient=1e-4)


@fast
def test_values_outside_0_1(backend):
    pair = [6 * image - 3 for image in images("noise", 3, 12, 20)]
    assert_close(both_ways(*pair, backend=backend), both_ways(*pair, dtype=torch.float64))


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_masked_pixels_take_the_targets_values(backend):
    rendered, target = images("noise", 2, 3, 12, 20)
    masks = torch.rand(2, 12, 20) > 0.3
    seen = masks[:, None].expand_as(rendered)
    dtype = torch.float64 if backend == "reference" else torch.float32
    options = {"dtype": dtype, "backend": backend}
    loss, grad = both_ways(rendered.where(seen, torch.nan), target, masks=masks, **options)
    exact_loss, exact_grad = both_ways(rendered.where(seen, target), target, **options)
    assert torch.equal(loss, exact_loss)
    assert torch.equal(grad, exact_grad.where(seen, 0))
    nothing, none = both_ways(rendered, target, masks=torch.zeros_like(masks), **options)
    assert nothing.abs().max() < 1e-12 and (none == 0).all()


@fast
def test_batches_and_repeated_runs_give_the_same_bits(backend):
    rendered, target = images("alike", 2, 1, 3, *SIZES[-1])
    loss, grad = both_ways(rendered, target, backend=backend)
    assert loss.shape == (2, 1)
    again = both_ways(rendered, target, backend=backend)
    assert all(map(torch.equal, again, (loss, grad)))
    for i in range(2):
        alone = both_ways(rendered[i, 0], target[i, 0], backend=backend)
        assert torch.equal(loss[i, 0], alone[0]) and torch.equal(grad[i, 0], alone[1])


def test_any_number_of_threads_gives_the_same_bits(threads):
    pair = images("alike", 2, 2, 3, 150, 70)
    threads(1)
    one = both_ways(*pair)
    for count in (2, 3):
        threads(count)
        assert all(map(torch.equal, both_ways(*pair), one))


@fast
@pytest.mark.parametrize("size", [(11, 20), (7, 5)], ids=str)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_non_finite_pixels_affect_their_image_only(size, value, backend):
    rendered, target = images("noise", 3, 3, *size)
    clean = both_ways(rendered, target, backend=backend)
    rendered[1, 2, 3, 4] = value
    loss, grad = both_ways(rendered, target, backend=backend)
    assert not loss[1].isfinite()
    for good in (0, 2):
        assert torch.equal(loss[good], clean[0][good])
        assert torch.equal(grad[good], clean[1][good])
    if value != value:
        assert grad[1, 2, 3, 4].isnan()


def test_gradients_on_demand():
    rendered, target = images("noise", 2, 3, 20, 20)
    assert not image_loss(rendered, target).requires_grad
    rendered.requires_grad_()
    target.requires_grad_()
    loss = image_loss(rendered, target)
    weights = torch.tensor([1.0, -3.0])
    first, of_target = torch.autograd.grad(
        (weights * loss).sum(), (rendered, target), retain_graph=True, allow_unused=True
    )
    assert of_target is None
    again, *_ = torch.autograd.grad(loss.sum(), rendered)
    torch.testing.assert_close(first, weights[:, None, None, None] * again)


def test_other_layouts_and_types():
    pair = [image.movedim(-1, -3) for image in images("noise", 2, 20, 30, 3)]
    whole = both_ways(*(image.contiguous() for image in pair))
    assert all(map(torch.equal, both_ways(*pair), whole))
    half = [image.bfloat16() for image in pair]
    assert torch.equal(image_loss(*half), image_loss(*(image.float() for image in half)))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = image_loss(*pair, backend="reference")
    assert torch.equal(inside, image_loss(*pair, backend="reference"))


def test_mistakes_are_named():
    rendered, target = images("noise", 3, 20, 20)
    few = torch.ones(3, 20, dtype=torch.bool)
    wrong = {
        r"rendered has shape \(20, 20\): expected \[..., 3, H, W\]": (rendered[0], target[0]),
        r"target has shape \(3, 20, 19\): expected \(3, 20, 20\)": (rendered, target[..., 1:]),
        "target is torch.uint8: give floating": (rendered, target.byte()),
        "ssim_weight=1.5: give a number from 0 to 1": (rendered, target, 1.5),
        r"masks has shape \(3, 20\): expected \(20, 20\)": (rendered, target, 0.2, few),
    }
    for sentence, args in wrong.items():
        with pytest.raises(InputError, match=sentence):
            inspect.unwrap(image_loss)(*args)  # without the tests' type checker
    with pytest.raises(InputError, match="backend='gpu': expected one of auto, reference, cpu"):
        image_loss(rendered, target, backend="gpu")
    with pytest.raises(InputError, match="computes in float32"):
        image_loss(rendered.double(), target, backend="cpu")
