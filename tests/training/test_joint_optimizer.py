"""Several optimizers step as one, and continue from a checkpoint with the same bits."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from asysplat.training.module import block_matrices
from asysplat.training.optimizers import JointOptimizer, Muon, cosine


def make_joint():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 3))
    matrices = [net[0].weight]
    others = [parameter for parameter in net.parameters() if parameter is not net[0].weight]
    joint = JointOptimizer(torch.optim.AdamW(others, lr=0.01), Muon(matrices, lr=0.1))
    return net, joint, cosine(joint, warmup_steps=2, total_steps=20)


def run(net, joint, schedule, steps):
    for step in steps:
        joint.zero_grad()
        inputs = torch.randn(5, 6, generator=torch.Generator().manual_seed(step))
        net(inputs).square().mean().backward()
        joint.step()
        schedule.step()


def test_each_parameter_is_stepped_by_its_own_optimizer_at_its_own_rate():
    net, joint, schedule = make_joint()
    run(net, joint, schedule, range(6))
    alone, _, _ = make_joint()
    parts = (
        torch.optim.AdamW([p for p in alone.parameters() if p is not alone[0].weight], lr=0.01),
        Muon([alone[0].weight], lr=0.1),
    )
    schedules = [cosine(part, warmup_steps=2, total_steps=20) for part in parts]
    for step in range(6):
        alone.zero_grad()
        inputs = torch.randn(5, 6, generator=torch.Generator().manual_seed(step))
        alone(inputs).square().mean().backward()
        for part, one in zip(parts, schedules, strict=True):
            part.step()
            one.step()
    for a, b in zip(net.parameters(), alone.parameters(), strict=True):
        assert torch.equal(a, b)
    assert [group["lr"] for group in joint.param_groups] == [
        part.param_groups[0]["lr"] for part in parts
    ]


def test_a_resumed_run_continues_with_the_same_bits():
    net, joint, schedule = make_joint()
    run(net, joint, schedule, range(4))
    saved = deepcopy((net.state_dict(), joint.state_dict(), schedule.state_dict()))
    run(net, joint, schedule, range(4, 8))
    other, again, rates = make_joint()
    for part, state in zip((other, again, rates), saved, strict=True):
        part.load_state_dict(state)
    run(other, again, rates, range(4, 8))
    for a, b in zip(net.parameters(), other.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("model", ["asysplat_4m4s", "gs_lrm"])
def test_the_matrices_of_blocks_are_neither_tokenizer_nor_head(build, model):
    net = build(f"model={model}", "width=0.1", device="meta")
    names = {parameter: name for name, parameter in net.named_parameters()}
    found = {names[matrix] for matrix in block_matrices(net)}
    assert found and all(names.endswith(".weight") for names in found)
    assert not any(
        name.startswith(("head", "tokenizer", "coarse_tok", "fine_tok")) for name in found
    )
    assert all(matrix.ndim == 2 for matrix in block_matrices(net))
