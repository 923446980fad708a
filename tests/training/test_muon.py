"""Muon's steps are orthogonal, and torch's up to its bfloat16."""

import torch

from asysplat.training.optimizers import Muon, orthogonalize

SHAPES = [(12, 12), (8, 20), (20, 8), (8, 20)]


def test_singular_values_become_about_one():
    for shape in SHAPES:
        matrices = torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
        u, s, v = torch.linalg.svd(matrices, full_matrices=False)
        graded = (u * torch.logspace(0, -2, s.shape[1])) @ v
        rotated = u.mT @ orthogonalize(graded) @ v.mT
        values = rotated.diagonal(dim1=1, dim2=2)
        assert (rotated - torch.diag_embed(values)).abs().max() < 1e-4
        assert values.min() > 0.4 and values.max() < 1.25


def test_steps_are_those_of_torch():
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in SHAPES]
    ours, theirs = ([m.clone().requires_grad_() for m in start] for _ in range(2))
    rates = {"lr": 0.01, "weight_decay": 0.1}
    both = Muon(ours, **rates), torch.optim.Muon(theirs, adjust_lr_fn="match_rms_adamw", **rates)
    for _ in range(4):
        for a, b in zip(ours, theirs, strict=True):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        for optimizer in both:
            optimizer.step()
    for a, b, before in zip(ours, theirs, start, strict=True):
        assert (a - b).norm() < 0.02 * (b - before).norm()


def test_a_matrix_without_gradient_stays():
    matrix, zero = torch.ones(3, 4, requires_grad=True), torch.ones(3, 4, requires_grad=True)
    zero.grad = torch.zeros(3, 4)
    Muon([matrix, zero], lr=0.1).step()
    assert torch.equal(matrix, torch.ones(3, 4)) and torch.equal(zero, torch.ones(3, 4))
