import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from asysplat.data.images import (
    Lens,
    image_size,
    load_depth,
    load_image,
    load_mask,
    load_reduced,
    resize_and_crop,
    resized_intrinsics,
    undistort,
)
from asysplat.errors import InputError

WIDE = {"width": 160, "height": 120, "fx": 100.0, "fy": 105.0, "cx": 82.0, "cy": 57.5}
BARREL = Lens(**WIDE, model="FULL_OPENCV", distortion=(-0.25, 0.06, 0.002, -0.003, 0.01))
FISHEYE = Lens(**WIDE, model="OPENCV_FISHEYE", distortion=(0.05, -0.02, 0.01, -0.002))


def distort(points: np.ndarray, lens: Lens) -> np.ndarray:
    """The lens equations of the OpenCV manual, on pinhole pixel positions [..., 2]."""
    x, y = (points[..., 0] - lens.cx) / lens.fx, (points[..., 1] - lens.cy) / lens.fy
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = lens.distortion
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x, y = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    return np.stack((x * lens.fx + lens.cx, y * lens.fy + lens.cy), -1)


def pixel_centers(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def blob(centers: np.ndarray, position: np.ndarray) -> np.ndarray:
    return np.exp(-((centers - position) ** 2).sum(-1) / (2 * 2.0**2))


def centroid(image: np.ndarray) -> np.ndarray:
    centers = pixel_centers(image.shape[1], image.shape[0])
    return (centers * image[..., None]).sum((0, 1)) / image.sum()


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["opencv", "fisheye"])
def test_images_are_undistorted_to_a_thousandth_of_a_pixel_as_by_opencv(lens):
    width, height = 80, 60  # half the image's size
    matrix = np.array([[50.0, 0, 41 - 0.5], [0, 52.5, 28.75 - 0.5], [0, 0, 1]])
    model = cv2.fisheye if lens is FISHEYE else cv2
    x, y = model.initUndistortRectifyMap(
        *(matrix, np.array(lens.distortion), np.eye(3), matrix, (width, height), cv2.CV_32FC1)
    )
    inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    columns, rows = (ramp.astype(np.float32) for ramp in np.indices((height, width))[::-1])
    for ramp, expected in ((columns, x), (rows, y)):
        found = undistort(ramp, lens)
        # OpenCV itself interpolates between 32 positions of a pixel.
        assert np.abs(found - cv2.remap(ramp, x, y, cv2.INTER_LINEAR))[inside].max() < 1e-3
        assert np.abs(found - expected)[inside].max() < 1 / 32


def test_a_lens_is_colmap_s_camera_and_back():
    lens = Lens(160, 120, 100.0, 100.0, 82.0, 57.5, "RADIAL", (0.1, -0.02))
    assert Lens.from_camera(lens.camera()) == lens
    # Two focal lengths need a model that has them.
    scaled = Lens(160, 120, 100.0, 105.0, 82.0, 57.5, "RADIAL", (0.1, -0.02))
    camera = scaled.camera()
    assert camera.model_name == "OPENCV"
    assert camera.params.tolist() == [100, 105, 82, 57.5, 0.1, -0.02, 0, 0]
    one, two = lens.camera(), camera
    rays = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 1), (20, 3))
    stretched = (one.img_from_cam(rays) - (82, 57.5)) * (1, 1.05) + (82, 57.5)
    np.testing.assert_allclose(two.img_from_cam(rays), stretched, atol=1e-9)


def test_nearest_undistortion_mixes_no_values_and_is_zero_outside():
    stored = np.random.default_rng(0).integers(1, 9, (60, 80)).astype(np.float32)
    pincushion = Lens(**WIDE, model="FULL_OPENCV", distortion=(0.3, 0.0, 0.0, 0.0, 0.0))
    flat = undistort(stored, pincushion, nearest=True)
    assert set(np.unique(flat)) <= set(range(9)) and flat[0, 0] == 0
    # Half the image's size, so every position halves.
    x, y = distort(np.array([61.0, 41.0]), pincushion) / 2
    assert flat[20, 30] == stored[int(y), int(x)]
    assert undistort(stored, Lens(**WIDE, model="OPENCV", distortion=(0.0,) * 4)) is stored


def test_pixels_that_the_lens_does_not_see_are_masked():
    lens = Lens(**WIDE, model="DIVISION", distortion=(0.45,))
    rays = np.ones((120, 160, 3))
    rays[..., :2] = (pixel_centers(160, 120) - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    pixels = lens.camera().img_from_cam(rays.reshape(-1, 3)).reshape(120, 160, 2)
    inside = ((pixels > 0) & (pixels < (160, 120))).all(-1)
    assert np.isnan(pixels[0, 0]).all() and 0.1 < inside.mean() < 0.9
    assert np.array_equal(undistort(np.ones((120, 160), bool), lens), inside)


@pytest.mark.parametrize("height, width", [(40, 60), (60, 40), (150, 300)])
def test_resized_content_and_intrinsics_move_together(height, width):
    lens = Lens(**WIDE)
    matrix = resized_intrinsics(lens, height, width)
    for point in [(0.1, 0.05, 1.0), (-0.2, -0.1, 1.2)]:
        x, y, z = point
        before = np.array([lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy])
        image = blob(pixel_centers(160, 120), before).astype(np.float32)
        after = (matrix @ point)[:2] / z
        found = centroid(np.maximum(resize_and_crop(image, height, width), 0))
        assert np.abs(found - after).max() < 0.05


def test_shrinking_averages_and_the_same_size_changes_nothing():
    checker = (np.indices((64, 64)).sum(0) % 2 * 255).astype(np.uint8)
    small = resize_and_crop(checker, 16, 16)
    assert np.abs(small.astype(int) - 127).max() <= 2
    pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    assert np.array_equal(resize_and_crop(pixels, 12, 16), pixels)
    expected = [[100, 0, 82], [0, 105, 57.5], [0, 0, 1]]
    assert np.array_equal(resized_intrinsics(Lens(**WIDE), 120, 160), expected)
    # Nearest takes the pixel under each new center.
    depth = np.arange(36, dtype=np.float32).reshape(6, 6)
    assert np.array_equal(resize_and_crop(depth, 2, 2, nearest=True), depth[[1, 4]][:, [1, 4]])


def test_bilinear_is_between_the_nearest_pixels():
    """As Long-LRM's, torch's without antialiasing."""
    pixels = np.random.default_rng(0).random((48, 96)).astype(np.float32)
    for size in ((16, 32), (11, 22), (60, 120)):
        found = resize_and_crop(pixels, *size, resampling="bilinear")
        expected = F.interpolate(torch.from_numpy(pixels)[None, None], size, mode="bilinear")
        assert np.allclose(found, expected[0, 0].numpy(), atol=1e-5)
    smooth = resize_and_crop(pixels, 12, 24, resampling="bicubic")
    assert smooth.std() < 0.5 * resize_and_crop(pixels, 12, 24, resampling="bilinear").std()


def test_a_mask_keeps_pixels_that_are_kept_wholly():
    mask = np.ones((6, 8), bool)
    mask[3, 5] = False
    small = np.ones((3, 4), bool)
    small[1, 2] = False
    assert np.array_equal(resize_and_crop(mask, 3, 4), small)
    assert np.array_equal(resize_and_crop(small, 6, 8), small.repeat(2, 0).repeat(2, 1))
    for factor in (7, 50):
        large = np.ones((3 * factor, 4 * factor), bool)
        assert resize_and_crop(large, 3, 4).all()
        large[factor, 2 * factor] = False
        assert np.array_equal(resize_and_crop(large, 3, 4), small)


def test_transparent_pixels_become_white(tmp_path):
    pixels = np.zeros((2, 3, 4), np.uint8)
    pixels[0], pixels[1] = (200, 100, 0, 255), (200, 100, 0, 0)
    pixels[0, 0, 3] = 51
    Image.fromarray(pixels).save(tmp_path / "a.png")
    loaded = load_image(tmp_path / "a.png")
    assert loaded[0, 1].tolist() == [200, 100, 0] and loaded[1, 1].tolist() == [255] * 3
    assert np.abs(loaded[0, 0].astype(int) - (244, 224, 204)).max() <= 1


@pytest.mark.parametrize(("least", "factor"), [(601, 1), (600, 2), (250, 4), (20, 8)])
def test_a_jpeg_is_decoded_at_the_least_size_that_is_enough(tmp_path, least, factor):
    x, y = np.meshgrid(np.arange(1600) / 1600, np.arange(1200) / 1200)
    pixels = (255 * np.stack((x, y, (1 + np.sin(20 * x)) / 2), -1)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    reduced = load_reduced(tmp_path / "a.jpg", least)
    assert reduced.shape == (1200 // factor, 1600 // factor, 3)
    small = [resize_and_crop(image, 60, 80) for image in (reduced, load_image(tmp_path / "a.jpg"))]
    assert np.abs(np.subtract(*small, dtype=np.int64)).max() <= 2
    Image.fromarray(pixels[:, 1:]).save(tmp_path / "odd.jpg")
    assert load_reduced(tmp_path / "odd.jpg", 20).shape == (1200, 1599, 3)


def test_load_image_does_not_apply_exif_orientation(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (20, 10)).save(tmp_path / "a.jpg", exif=exif)
    assert image_size(tmp_path / "a.jpg") == (20, 10)
    assert load_image(tmp_path / "a.jpg").shape == (10, 20, 3)


def test_depth_keeps_sixteen_bits_and_mask_is_nonzero(tmp_path):
    stored = np.array([[0, 1, 300], [40000, 65535, 7]], np.uint16)
    cv2.imwrite(str(tmp_path / "depth.png"), stored)
    assert np.array_equal(load_depth(tmp_path / "depth.png"), stored)
    Image.fromarray(np.array([[0, 1, 255]], np.uint8)).save(tmp_path / "mask.png")
    assert load_mask(tmp_path / "mask.png").tolist() == [[False, True, True]]


def test_a_cut_off_image_is_refused_when_opened(tmp_path):
    cut = tmp_path / "cut.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(cut)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    for read in (image_size, load_image):
        with pytest.raises(InputError, match=r"cut\.jpg cannot be read"):
            read(cut)


def test_only_formats_of_photographs_are_opened(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png", format="EPS")
    with pytest.raises(InputError, match=r"a\.png cannot be read as an image"):
        load_image(tmp_path / "a.png")


def test_depth_maps_and_images_are_not_confused(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((2, 2), 40000, np.uint16))
    with pytest.raises(InputError, match="8-bit RGB"):
        load_image(tmp_path / "depth.png")
    Image.new("RGB", (2, 2)).save(tmp_path / "photograph.png")
    with pytest.raises(InputError, match="3 channels"):
        load_depth(tmp_path / "photograph.png")
