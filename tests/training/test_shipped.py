"""The model that ships: what it is, and real photographs beside what one gets for nothing.

pytest tests/training/test_shipped.py -m slow -s prints the numbers of the README.
"""

import itertools

import pytest
import torch

from asysplat import load, open_photographs, render
from asysplat.data import FilesSource, SceneOptions
from asysplat.data.datamodule import FixedTasks
from asysplat.evaluation.lpips import load_lpips, lpips_distance
from asysplat.evaluation.metrics import mean_color_images, nearest_view_images, psnr

SCENES = {"fern": (8, 15), "fox": (8, 16, 32), "hololens-000": (8, 16, 32), "mydesk": (8, 16, 32)}
TARGETS = 4


def predicted(inputs, targets):
    gaussians = load("shipped")(inputs)
    return render(gaussians, targets.cameras, inputs.mean_color(), depth=False).image.clamp(0, 1)


def measure(lpips, sample):
    """PSNR and LPIPS of the model, of the nearest view and of the mean color."""
    inputs, targets = sample["inputs"], sample["targets"]
    image = predicted(inputs, targets)
    drawn = (image, nearest_view_images(inputs, targets), mean_color_images(inputs, targets))
    true = targets.images
    return [
        (psnr(each, true).mean().item(), lpips_distance(lpips, each, true).mean().item())
        for each in drawn
    ]


@pytest.mark.medium
@pytest.mark.parametrize("most", [8, pytest.param(32, marks=pytest.mark.slow)])
def test_real_photographs_are_better_than_the_baselines(shared, most):
    """PSNR above the nearest view's and the mean color's everywhere, LPIPS on half the scenes."""
    lpips = load_lpips("alex", shared / "weights")
    if lpips is None:
        pytest.skip(f"{shared} has no weights of LPIPS")
    sharper = 0
    for scene, numbers in SCENES.items():
        folder = shared / "data" / scene
        if not folder.is_dir():
            pytest.skip(f"{folder} is absent")
        distances = []
        for size, views in itertools.product((128, 256), (n for n in numbers if n <= most)):
            source = FilesSource(str(folder), SceneOptions(size, size), window=(24, 96))
            (sample,) = FixedTasks(source.evaluation("test", views, TARGETS))
            model, nearest, mean = measure(lpips, sample)
            cells = " | ".join(f"{p:.2f} / {d:.3f}" for p, d in (model, nearest, mean))
            print(f"| {scene}, {views} views of {size}x{size} | {cells} |")
            assert model[0] > max(nearest[0], mean[0]), (scene, size, views)
            distances.append((model[1], nearest[1]))
        ours, theirs = torch.tensor(distances).mean(0)
        sharper += int(ours < theirs)
    assert sharper >= len(SCENES) / 2


@pytest.mark.medium
def test_the_order_of_the_photographs_does_not_matter(shared):
    """With few that overlap, so that some have fewer neighbors than are compared."""
    folder = shared / "data" / "mydesk"
    if not folder.is_dir():
        pytest.skip(f"{shared} has no data/mydesk")
    photographs = open_photographs(folder, height=128, width=128, views=8)
    inputs, held_out = photographs.inputs, photographs.held_out.select(range(4))
    found = []
    for order in (range(8), (7, 2, 5, 0, 3, 6, 1, 4), (3, 1, 7, 6, 0, 2, 5, 4)):
        image = predicted(inputs.select(order), held_out)
        found.append(psnr(image, held_out.images).mean().item())
    assert max(found) - min(found) < 0.1
