"""Both scans against published implementations, where they are installed."""

import pytest
import torch
import torch.nn.functional as F

from asysplat.ops import selective_scan, ssd


def test_selective_scan_of_mamba_ssm():
    published = pytest.importorskip(
        "mamba_ssm.ops.selective_scan_interface", exc_type=ImportError
    ).selective_scan_ref
    x, dt = torch.randn(2, 70, 6), torch.rand(2, 70, 6)
    A, D = -torch.rand(6, 4) - 0.1, torch.randn(6)
    B, C = torch.randn(2, 2, 70, 4)
    # Time comes last there.
    expected = published(x.mT, dt.mT, A, B.mT, C.mT, D).mT
    torch.testing.assert_close(selective_scan(x, dt, A, B, C, D), expected)


def test_ssd_in_the_mamba2_of_transformers():
    transformers = pytest.importorskip("transformers")
    modeling = pytest.importorskip("transformers.models.mamba2.modeling_mamba2")
    sizes = {"hidden_size": 16, "expand": 2, "head_dim": 8, "num_heads": 4, "n_groups": 1}
    sizes |= {"state_size": 6, "chunk_size": 32, "num_hidden_layers": 1}
    config = transformers.Mamba2Config(**sizes)
    mixer = modeling.Mamba2Mixer(config, layer_idx=0)
    for parameter in (mixer.A_log, mixer.D, mixer.dt_bias):
        torch.nn.init.uniform_(parameter)
    u = torch.randn(2, 70, 16)

    # The same layer, with this scan in it.
    gate, xBC, dt = mixer.in_proj(u).split([32, 32 + 2 * 6, 4], dim=-1)
    xBC = F.silu(mixer.conv1d(xBC.mT)[..., :70].mT)
    x, B, C = xBC.split([32, 6, 6], dim=-1)
    dt = F.softplus(dt + mixer.dt_bias)
    y = ssd(x.unflatten(-1, (4, 8)), dt, -mixer.A_log.exp(), B, C, mixer.D).flatten(2)
    torch.testing.assert_close(mixer.out_proj(mixer.norm(y, gate)), mixer(u))
