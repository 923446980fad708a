import pytest
import torch
from skimage.metrics import structural_similarity

from asysplat.errors import InputError
from asysplat.evaluation.metrics import abs_rel, delta1, psnr, ssim


def test_psnr_of_known_errors():
    target = torch.full((2, 3, 3, 4, 5), 0.5)
    offsets = torch.tensor([[0.1, 0.01, 0.0], [0.5, 0.25, 2.0]])
    rendered = target + offsets[..., None, None, None]
    # Identical images stop at 100 dB; an offset of 2 is clamped to white, an error of 0.5.
    expected = [[20, 40, 100], [6.0206, 12.0412, 6.0206]]
    torch.testing.assert_close(psnr(rendered, target), torch.tensor(expected), atol=1e-3, rtol=0)


def test_metrics_of_low_precision_are_computed_in_fp32():
    target = torch.rand(1, 3, 16, 16).bfloat16()
    assert psnr(target, target).dtype == torch.float32
    assert psnr(target, target).item() == pytest.approx(100)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        noisy = target.float() + 0.1 * torch.randn(1, 3, 16, 16)
        inside = ssim(noisy, target)
    torch.testing.assert_close(inside, ssim(noisy, target), rtol=0, atol=0)


def test_depth_errors_over_known_pixels():
    target = torch.tensor([[[2.0, 4.0], [0.0, 10.0]], [[0.0, 0.0], [0.0, 0.0]]])
    depth = torch.tensor([[[2.2, 6.0], [9.0, 9.0]], [[1.0, 1.0], [1.0, 1.0]]])
    error = abs_rel(depth, target)
    assert error[0].item() == pytest.approx((0.1 + 0.5 + 0.1) / 3)
    share = delta1(depth, target)
    assert share[0].item() == pytest.approx(2 / 3)
    assert error[1].isnan() and share[1].isnan()


def test_delta1_is_strict_and_two_sided():
    target = torch.full((1, 1, 6), 4.0)
    depth = torch.tensor([[[5.0, 3.2, 4.99, 3.21, 0.0, -4.0]]])
    assert delta1(depth, target).item() == pytest.approx(2 / 6)


def test_median_alignment_removes_the_scale_of_each_view():
    target = torch.rand(2, 4, 3, 5) + 1
    target[..., 0, 0] = 0
    depth = target * torch.tensor([0.5, 3.0, 1.0, 20.0])[:, None, None]
    depth[..., 0, 0] = 1e6  # unknown: must not move the median
    assert abs_rel(depth, target)[:, 3].min() > 10
    torch.testing.assert_close(abs_rel(depth, target, "median"), torch.zeros(2, 4))
    torch.testing.assert_close(delta1(depth, target, alignment="median"), torch.ones(2, 4))
    target = torch.full((1, 2, 3), 4.0)  # a median of 0 cannot be aligned
    depth = torch.tensor([[[4.0, 0.0, 0.0], [0.0, 0.0, 8.0]]])
    assert abs_rel(depth, target, "median").item() == pytest.approx(5 / 6)
    assert delta1(depth, target, "median").item() == pytest.approx(1 / 6)


# Options of scikit-image's structural_similarity for each window.
SCIKIT = {"gaussian": {"gaussian_weights": True, "sigma": 1.5, "win_size": 11}, "uniform": {}}


@pytest.mark.parametrize("window, options", SCIKIT.items())
@pytest.mark.parametrize("covariance", ["biased", "sample"])
def test_ssim_equals_scikit_image(window, options, covariance):
    a = torch.rand(2, 2, 3, 24, 31).double()
    a[1] = 0.5  # flat: variances are 0
    b = (a + 0.2 * torch.randn_like(a)).clamp(0, 1)
    expected = [
        structural_similarity(
            *(image.numpy() for image in pair),
            channel_axis=0,
            data_range=1,
            use_sample_covariance=covariance == "sample",
            **options,
        )
        for pair in zip(b.flatten(0, 1), a.flatten(0, 1), strict=True)
    ]
    found = ssim(b.float(), a.float(), window, covariance).flatten().tolist()
    assert found == pytest.approx(expected, abs=1e-5)


def test_smallest_image_of_each_window():
    for window, size in (("gaussian", 11), ("uniform", 7)):
        image = torch.rand(1, 3, size, size)
        torch.testing.assert_close(ssim(image, image, window), torch.ones(1))
        with pytest.raises(InputError, match=f"{size}x{size} pixels, these have {size}x{size - 1}"):
            ssim(image[..., 1:], image[..., 1:], window)
