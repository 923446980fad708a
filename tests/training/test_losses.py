"""Each term of the objective against its formula, and off where it has nothing to compare."""

import pytest
import torch

from asysplat.rendering import Rendering
from asysplat.scene import Cameras, Views
from asysplat.training import ReconstructionLoss
from asysplat.training.losses import disparity_loss, normalised_disparity


def pair(size=32, depths=True):
    pose = torch.eye(4).expand(2, 4, 4)
    intrinsics = torch.tensor([[30.0, 0, size / 2], [0, 30.0, size / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics.expand(2, 3, 3), pose, size, size)
    depth = 1 + torch.rand(2, size, size)
    targets = Views(cameras, torch.rand(2, 3, size, size), depth if depths else None)
    rendering = Rendering(
        image=torch.rand(2, 3, size, size).requires_grad_(),
        alpha=torch.ones(2, size, size),
        depth=(1 + torch.rand(2, size, size)).requires_grad_(),
        stats={},
    )
    return rendering, targets


def test_mean_squared_error():
    rendering, targets = pair()
    terms = ReconstructionLoss(mse=2.0, perceptual=0.0, depth=0.0)(rendering, targets)
    expected = (rendering.image - targets.images).square().mean()
    torch.testing.assert_close(terms["loss"], 2 * expected)
    assert set(terms) == {"loss", "mse"}


def test_disparity_does_not_see_scale_and_shift():
    _, targets = pair()
    ones = torch.ones_like(targets.depths)
    disparity = 1 / targets.depths
    other = 1 / (3 * disparity + 0.2)
    assert disparity_loss(other, ones, targets.depths) < 1e-6
    assert disparity_loss(targets.depths.flip(-1), ones, targets.depths) > 0.1


def test_normalised_disparity_by_hand():
    depth = torch.tensor([[[1.0, 0.5], [0.25, 7.0]]])
    valid = torch.tensor([[[True, True], [True, False]]])
    # Disparities 1, 2, 4: median 2, mean absolute deviation (1 + 0 + 2) / 3.
    expected = torch.tensor([[[-1.0, 0.0], [2.0, 0.0]]])
    torch.testing.assert_close(normalised_disparity(depth, valid), expected)


def test_pixels_without_depth_do_not_count():
    rendering, targets = pair()
    hole = targets.depths.clone()
    hole[:, :8] = 0
    terms = ReconstructionLoss(mse=0.0, perceptual=0.0, depth=1.0)(
        rendering, Views(targets.cameras, targets.images, hole)
    )
    terms["loss"].backward()
    assert (rendering.depth.grad[:, :8] == 0).all()
    assert rendering.depth.grad.isfinite().all() and rendering.depth.grad.abs().sum() > 0


def test_no_known_depth_at_all_gives_zero_and_no_nan():
    rendering, targets = pair()
    loss = disparity_loss(rendering.depth, rendering.alpha, torch.zeros_like(targets.depths))
    loss.backward()
    assert loss == 0
    assert (rendering.depth.grad == 0).all()


def test_data_without_depth_turns_the_term_off():
    rendering, targets = pair(depths=False)
    assert "depth" not in ReconstructionLoss(mse=1.0, perceptual=0.0, depth=1.0)(rendering, targets)


def test_missing_backbone_is_said_and_the_term_is_off(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.warns(UserWarning, match="paths.weights"):
        loss = ReconstructionLoss(mse=1.0, perceptual=0.5, depth=0.0, weights=str(tmp_path))
    assert set(loss(*pair())) == {"loss", "mse"}


def test_perceptual_term(shared):
    loss = ReconstructionLoss(mse=0.0, perceptual=1.0, depth=0.0, weights=str(shared / "weights"))
    rendering, targets = pair()
    loss(rendering, targets)["loss"].backward()
    assert rendering.image.grad.abs().sum() > 0
    same = Rendering(targets.images, rendering.alpha, None, {})
    assert loss(same, targets)["perceptual"] == 0
    assert not loss.state_dict()
