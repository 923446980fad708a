"""Photographs that are far less sharp than their neighbors are found, and left out at the end."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from asysplat.evaluation.metrics import psnr
from asysplat.refinement import DEFAULT, refine
from asysplat.refinement.blur import find_blurred
from asysplat.rendering import render

MOVED = [1, 6, 9]  # photographs of a moving camera


@pytest.fixture(scope="module")
def unsteady(room):
    images = room[0].images.clone()
    images[MOVED] = F.avg_pool2d(F.pad(images[MOVED], (3, 3, 0, 0), "replicate"), (1, 7), stride=1)
    return replace(room[0], images=images)


def test_blurred_photographs_are_found(room, unsteady):
    inputs = room[0]
    assert not find_blurred(inputs.images, inputs.cameras).any()
    found = find_blurred(unsteady.images, unsteady.cameras)
    assert torch.nonzero(found)[:, 0].tolist() == MOVED
    one = inputs.select([0])
    assert not find_blurred(one.images, one.cameras).any()


@pytest.mark.medium
def test_blurred_photographs_do_not_blur_the_scene(room, unsteady, start):
    held, quality = room[1], {}
    for robust in (False, True):
        scene = refine(start, unsteady, replace(DEFAULT, robust=robust), steps=300)
        image = render(scene, held.cameras, room[0].mean_color()).image
        quality[robust] = psnr(image, held.images).mean().item()
    assert quality[True] > quality[False] + 0.3, quality
