"""Columns of the figures, and their content where depths are unknown or masked."""

from dataclasses import replace

import pytest
import torch

from asysplat import Cameras, Views
from asysplat.evaluation.figures import comparison_figure
from asysplat.rendering import Rendering


def scene(depths=True):
    intrinsics = torch.tensor([[20.0, 0, 8.0], [0, 20.0, 8.0], [0, 0, 1]]).repeat(2, 1, 1)
    cameras = Cameras(intrinsics, torch.eye(4).repeat(2, 1, 1), 16, 16)
    images = torch.rand(2, 3, 16, 16)
    views = Views(cameras, images, torch.ones(2, 16, 16) if depths else None)
    return views, Rendering(images, torch.ones(2, 16, 16), torch.full((2, 16, 16), 2.0), {})


def test_the_comparison_has_a_row_for_each_view_and_true_depths_where_known():
    for depths, columns in ((True, 7), (False, 5)):
        views, rendering = scene(depths)
        axes = comparison_figure(views, views, rendering).axes
        assert len(axes) == 2 * columns
        assert axes[2].get_xlabel() == "100.0 dB"
        if depths:
            assert "depth error" in axes[6].get_title()
            assert axes[6].get_xlabel() == "AbsRel 1.000"  # 2 where it is 1


def test_masked_pixels_are_blank_and_not_in_the_color_range():
    views, rendering = scene()
    masks = torch.ones(2, 16, 16, dtype=torch.bool)
    masks[:, :, :4] = False
    depths = torch.where(masks, 2.0, 0.01)  # masked depths would be the brightest
    depths[:, 0], depths[:, 1] = 0, 2.5  # unknown, and rendered a fifth too near
    image = torch.where(masks[:, None], rendering.image, 0)
    rendering = replace(rendering, image=image, depth=torch.where(masks, 2.0, 0.0))
    figure = comparison_figure(views, replace(views, depths=depths, masks=masks), rendering)
    for row in (figure.axes[:7], figure.axes[7:]):
        assert row[2].get_xlabel() == "100.0 dB"
        shown = [axis.images[0].get_array() for axis in row[3:]]
        for values, value in zip(shown, (0.0, 0.5, 0.5, 0.0), strict=True):
            assert values.mask[:, :4].all() and (values[2:, 4:] == value).all()
        assert shown[2].mask[0].all() and shown[3].mask[0].all()
        assert shown[3][1, 4:].tolist() == pytest.approx([0.2] * 12)
        assert row[6].images[0].get_clim() == (0, 0.25)
        assert row[6].get_xlabel() == f"AbsRel {0.2 / 15:.3f}"
        assert row[4].images[0].get_clim() == row[5].images[0].get_clim() == (0, 0.5)
    nothing = replace(views, masks=torch.zeros_like(masks))
    comparison_figure(nothing, nothing, rendering).canvas.draw()
