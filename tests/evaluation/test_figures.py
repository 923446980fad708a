"""Columns of the figures, and their content where depths are unknown or masked."""

from dataclasses import replace

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
    for depths, columns in ((True, 6), (False, 5)):
        views, rendering = scene(depths)
        axes = comparison_figure(views, views, rendering).axes
        assert len(axes) == 2 * columns
        assert axes[2].get_xlabel() == "100.0 dB"


def test_masked_pixels_are_blank_and_not_in_the_color_range():
    views, rendering = scene()
    masks = torch.ones(2, 16, 16, dtype=torch.bool)
    masks[:, :, :4] = False
    depths = torch.where(masks, 2.0, 0.01)  # masked depths would be the brightest
    image = torch.where(masks[:, None], rendering.image, 0)
    rendering = replace(rendering, image=image, depth=torch.where(masks, 2.0, 0.0))
    figure = comparison_figure(views, replace(views, depths=depths, masks=masks), rendering)
    for row in (figure.axes[:6], figure.axes[6:]):
        assert row[2].get_xlabel() == "100.0 dB"
        for axis, value in zip(row[3:], (0.0, 0.5, 0.5), strict=True):
            (image,) = axis.images
            values = image.get_array()
            assert values.mask[:, :4].all() and (values[:, 4:] == value).all()
        assert row[4].images[0].get_clim() == row[5].images[0].get_clim() == (0, 0.5)
    nothing = replace(views, masks=torch.zeros_like(masks))
    comparison_figure(nothing, nothing, rendering).canvas.draw()
