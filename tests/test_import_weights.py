"""Weights of Long-LRM's public code give here what they give there.

long_lrm.npz has what the public code gave (https://github.com/arthurhero/Long-LRM, revision
d92dd51, in fp32 on a CPU, with formulas in place of the CUDA kernels of mamba_ssm and xformers):
names and shapes of the weights of configs/7m1t_tm.yaml, and each eleventh Gaussian that a smaller
model with the weights of `draw_weights` predicts.
"""

import json

import numpy as np
import pytest
import torch

from asysplat import load
from asysplat.errors import InputError
from asysplat.import_weights import convert_weights, import_weights
from asysplat.scene import Cameras, Views

SMALL = [
    *("state_size=8", "model.stage_widths=[64,128,128]"),
    *("model.stage_layers=[1m1t,1m,1m1t1m]", "model.stage_ratios=[4,4,4]"),
]


@pytest.fixture(scope="module")
def public(repository):
    return dict(np.load(repository / "tests" / "long_lrm.npz"))


def draw_weights(shapes):
    """Weights with these shapes from one stream of numpy, in the order of their names."""
    random, weights = np.random.RandomState(0), {}
    for name, shape in shapes.items():
        spread = 0.1 if len(shape) == 1 else 0.6 * np.prod(shape[1:]) ** -0.5
        middle = -2 if name.endswith("dt_bias") else len(shape) == 1 and not name.endswith("bias")
        values = middle + spread * random.standard_normal(shape)
        weights[name] = torch.from_numpy(values.astype(np.float32))
    return weights


@pytest.fixture
def write(public, tmp_path):
    """Write a checkpoint of the small model, as main.py there does, with changes."""

    def written(**changes):
        model = draw_weights(json.loads(str(public["small"])))
        model |= {"perceptual_loss.mean": torch.zeros(1, 3, 1, 1)} | changes
        model = {name: tensor for name, tensor in model.items() if tensor is not None}
        torch.save({"model": model, "optimizer": {}, "scheduler": {}}, tmp_path / "public.pt")
        return tmp_path / "public.pt"

    return written


def test_every_published_weight_has_a_place(public, build):
    """The 141.92M of Long-LRM at paper scale, on the meta device."""
    net = build("model=longlrm", "scale=paper", device="meta")
    shapes = json.loads(str(public["published"]))
    weights = {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
    converted = convert_weights(weights, net, "public.pt")
    assert {n: t.shape for n, t in converted.items()} == {
        n: t.shape for n, t in net.state_dict().items()
    }
    assert round(sum(t.numel() for t in converted.values()) / 1e6, 2) == 141.92


def test_the_gaussians_are_those_of_the_public_code(public, write, tmp_path, capsys):
    """In frames of any scale: there the largest coordinate is 1, here the farthest camera."""
    file = tmp_path / "long_lrm.safetensors"
    import_weights(write(), file, SMALL)
    assert f"{file}: " in capsys.readouterr().out
    net = load(str(file), ["model=longlrm", "scale=paper", *SMALL])
    poses = torch.from_numpy(public["cam_to_world"])
    farthest = poses[:, :3, 3].norm(dim=-1).max()
    assert farthest > 1.4
    poses[:, :3, 3] /= farthest
    intrinsics = torch.eye(3).repeat(len(poses), 1, 1)
    intrinsics[:, (0, 1, 0, 1), (0, 1, 2, 2)] = torch.from_numpy(public["intrinsics"])
    images = torch.from_numpy(public["images"]) / 255
    with torch.no_grad():
        gaussians = net(Views(Cameras(intrinsics, poses, *images.shape[2:]), images))
    gaussians = gaussians.scale_by(farthest.item())
    found = {
        "xyz": gaussians.means,
        "rotation": gaussians.quats,
        "scale": gaussians.scales.log(),
        "opacity": gaussians.opacities.logit()[:, None],
        "feature": gaussians.sh,
    }
    for name, values in found.items():
        expected = torch.from_numpy(public[name])
        assert expected.std() > 0.5
        torch.testing.assert_close(values[::11], expected, rtol=1e-4, atol=1e-4, msg=name)


BLOCK = "processor.blocks.1.attn.qkv.weight"
MISTAKES = {
    "missing": ({BLOCK: None}, SMALL, f"has no {BLOCK}: "),
    "unknown": ({"extra": torch.ones(1)}, SMALL, "also has extra: "),
    "of another shape": ({BLOCK: torch.ones(3, 64)}, SMALL, rf"{BLOCK} is \(3, 64\), but "),
    "of another model": ({}, ["model=asysplat_4m4s"], "a model other than Long-LRM"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_other_weights_are_refused_by_name(write, tmp_path, case):
    changes, overrides, message = MISTAKES[case]
    with pytest.raises(InputError, match=message):
        import_weights(write(**changes), tmp_path / "new.safetensors", overrides)
    assert not (tmp_path / "new.safetensors").exists()


def test_files_that_cannot_be_are_refused(write, tmp_path, repository):
    new = tmp_path / "new.safetensors"
    with pytest.raises(InputError, match="cannot be read as a checkpoint of Long-LRM"):
        import_weights(repository / "README.md", new, SMALL)
    with pytest.raises(InputError, match=r"is not named \.safetensors"):
        import_weights(write(), tmp_path / "new.ckpt", SMALL)
