"""Videos, read back frame by frame."""

import weakref

import numpy as np
import pytest
import torch

from asysplat.errors import InputError
from asysplat.export import write_video

av = pytest.importorskip("av")


def image(index: int, height: int, width: int) -> torch.Tensor:
    """Smooth colors that change from frame to frame."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return 0.25 + 0.5 * torch.stack((x, y, torch.full_like(x, index / 20)))


def frames_of(path) -> list[np.ndarray]:
    options = {"format": "rgb24", "interpolation": "ACCURATE_RND"}
    with av.open(path) as container:
        return [frame.to_ndarray(**options) for frame in container.decode(video=0)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "way.mp4"


@pytest.mark.parametrize(("height", "width"), [(32, 48), (33, 47), (1, 1)])
def test_all_frames_of_a_video_come_back(path, height, width):
    write_video(path, (image(i, height, width) for i in range(12)), fps=24)
    frames = frames_of(path)
    assert len(frames) == 12
    for index, frame in enumerate(frames):
        assert frame.shape == (height + height % 2, width + width % 2, 3)
        expected = 255 * image(index, height, width).permute(1, 2, 0).numpy()
        assert np.abs(frame[:height, :width] - expected).mean() < 3
        if width % 2:
            assert np.abs(frame[:, -1].astype(int) - frame[:, -2]).max() < 12  # a copy, not black


def test_videos_have_the_format_that_browsers_play(path):
    write_video(path, [image(i, 64, 64) for i in range(3)], fps=29.97)
    with av.open(path) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        assert (codec.name, codec.pix_fmt, codec.colorspace) == ("h264", "yuv420p", 1)
        assert (codec.color_primaries, codec.color_trc) == (1, 1)
        assert float(stream.average_rate) == pytest.approx(29.97)
        assert stream.frames == 3
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_colors_of_a_video_are_right_and_clamped(path):
    for color in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.2, 0.7, 0.4), (2, -1, 0.5)):
        values = torch.tensor(color, dtype=torch.float32)[:, None, None]
        write_video(path, [values.expand(3, 16, 16)])
        found = frames_of(path)[0].astype(float)
        expected = 255 * values.clamp(0, 1).permute(1, 2, 0).numpy()
        assert np.abs(found - expected).max() < 4, color


def test_writing_a_video_does_not_keep_its_images(path):
    alive = []

    def images():
        for index in range(12):
            made = image(index, 16, 16)
            alive.append(weakref.ref(made))
            yield made
            del made
            assert sum(ref() is not None for ref in alive) <= 1

    write_video(path, images())
    assert len(alive) == 12


@pytest.fixture
def old(path):
    """A file that stays as it is."""
    path.write_text("old")
    yield path
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]


def interrupted():
    yield image(0, 16, 16)
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("images", "error", "message"),
    [
        ([], InputError, "has no images"),
        ([image(0, 16, 16), image(0, 18, 16)], InputError, r"image 1 .*\(3, 18, 16\).*16 x 16"),
        ([image(0, 16, 16) * torch.nan], InputError, "image 0 of .*NaN"),
        (interrupted(), KeyboardInterrupt, None),
    ],
)
def test_a_video_that_fails_leaves_the_old_file(old, images, error, message):
    with pytest.raises(error, match=message):
        write_video(old, images)


def test_write_video_names_wrong_arguments(tmp_path):
    for name, fps, message in (
        ("way.avi", 30, r"way\.avi is not the name of a video"),
        ("way.mp4", 0, "fps is 0"),
    ):
        with pytest.raises(InputError, match=message):
            write_video(tmp_path / name, [image(0, 16, 16)], fps)
    assert not list(tmp_path.iterdir())
