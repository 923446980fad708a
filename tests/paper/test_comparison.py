"""The figure of several systems' renderings: its numbers, its crop, what is refused."""

import math
import re
from pathlib import Path

import pytest
import torch

from asysplat.data.write import write_image
from asysplat.errors import InputError
from asysplat.evaluation.view_images import NEAREST_INPUT, TARGET
from paper.comparison import draw_views, read_views

SIZE = (24, 32)
ERRORS = {"ours": 51, "other": 102}  # of 255


@pytest.fixture
def folders(tmp_path) -> list[Path]:
    """Two systems' black renderings of two white scenes, wrong in one square each."""
    for system, error in ERRORS.items():
        for number, scene in enumerate(("hall", "room")):
            target, rendered = torch.ones(3, *SIZE), torch.ones(3, *SIZE)
            rendered[:, 10:16, 8 * number : 8 * number + 8] -= error / 255
            images = {"": rendered, TARGET: target, NEAREST_INPUT: target * 0.8}
            for place, image in images.items():
                (tmp_path / system / scene / place).mkdir(parents=True, exist_ok=True)
                for name in ("00001.png", "00004.png"):
                    write_image(image, tmp_path / system / scene / place / name)
    return [tmp_path / system for system in ERRORS]


def test_columns_psnr_and_the_crop_with_the_largest_error(folders):
    figure = draw_views(read_views(folders))
    grid = [figure.axes[row : row + 4] for row in range(0, 16, 4)]
    titles = ["nearest input", "ours", "other", "ground truth"]
    assert [axes.get_title() for axes in grid[0]] == titles
    assert [grid[row][0].get_ylabel() for row in (0, 2)] == ["hall", "room"]
    # The square is a sixteenth of the image.
    mses = [0.2**2, *((error / 255) ** 2 / 16 for error in ERRORS.values())]
    expected = [f"{-10 * math.log10(mse):.2f} dB" for mse in mses]
    for number in (0, 1):
        whole, enlarged = grid[2 * number : 2 * number + 2]
        assert [axes.get_xlabel() for axes in enlarged] == [*expected, ""]
        for axes in whole:
            (frame,) = axes.patches
            assert frame.get_bbox().bounds == (8 * number - 0.5, 9.5, 8, 6)
        drawn = enlarged[2].images[0].get_array()
        assert drawn.shape == (6, 8, 3) and (drawn == drawn[0, 0, 0]).all()
        assert drawn[0, 0, 0] == pytest.approx(0.6)


def test_scenes_and_views_are_chosen(folders, run_script):
    """By names that look like numbers, too."""
    chosen = read_views(folders, ["room"], ["00004", "00001"])
    assert [view.scene for view in chosen] == ["room", "room"]
    images, output = f"images=[{folders[0]},{folders[1]}]", folders[0].parent
    result = run_script("report.py", images, "scenes=room", "views=[00004]", f"output={output}")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == f"figure: {output / 'comparison.png'}"
    assert (output / "comparison.png").is_file()


def test_what_is_missing_is_named(folders):
    with pytest.raises(InputError, match=re.escape("other/room has no image of view 00001")):
        (folders[1] / "room" / "00001.png").unlink()
        read_views(folders)
    with pytest.raises(InputError, match="has no scene with a folder target: begin with"):
        read_views([folders[0] / "room"])
    with pytest.raises(InputError, match="several folders named ours: rename all but one"):
        read_views([folders[0], folders[0]])
