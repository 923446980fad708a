"""Weights are downloaded once, into torch's hub cache, if requested; no test uses a network."""

import pytest
import torch
from omegaconf import OmegaConf
from torchvision.models import alexnet

from asysplat.errors import InputError
from asysplat.evaluation.backbones import find_backbone
from asysplat.evaluation.lpips import load_lpips

ALEXNET = "alexnet-owt-7be5be79.pth"


def write_alexnet(path, value, dtype=torch.float32):
    """AlexNet's weights, all equal to `value`; stored as one number a tensor."""
    with torch.device("meta"):
        shapes = {key: tensor.shape for key, tensor in alexnet().state_dict().items()}
    state = {key: torch.tensor(value, dtype=dtype).expand(shape) for key, shape in shapes.items()}
    torch.save(state, path)


@pytest.fixture
def requests(monkeypatch):
    """Requested addresses; each responds with torchvision's file, of zeros."""
    addresses = []

    def download(url, file, *_, **__):
        addresses.append(url)
        write_alexnet(file, 0.0)

    monkeypatch.setattr("torch.hub.download_url_to_file", download)
    return addresses


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """The folder of torch's hub cache, empty."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    return tmp_path / "hub" / "checkpoints"


def test_a_backbone_is_downloaded_once_and_only_if_requested(requests, hub, tmp_path):
    assert load_lpips("alex", None) is None
    assert load_lpips("vgg", tmp_path) is None
    assert find_backbone("alexnet", None) is None
    assert not requests
    found = find_backbone("alexnet", None, download=True)
    again = find_backbone("alexnet", None, download=True)
    assert len(requests) == 1 and requests[0].startswith("https://") and "alexnet" in requests[0]
    assert found.keys() == again.keys() == find_backbone("alexnet", None).keys()
    assert found["features.0.weight"].shape == (64, 3, 11, 11)


def test_the_hub_cache_comes_first_and_features_are_fp32(requests, hub, tmp_path):
    write_alexnet(tmp_path / "alexnet_features_fp16.pth", 2.0, torch.float16)
    found = find_backbone("alexnet", tmp_path, download=True)
    assert found["features.0.bias"].dtype == torch.float32 and not requests
    assert found["features.0.bias"].unique().tolist() == [2.0]
    write_alexnet(hub / ALEXNET, 1.0)
    found = find_backbone("alexnet", tmp_path)
    assert found["features.10.weight"].unique().tolist() == [1.0]
    assert sorted(found) == sorted(
        f"features.{n}.{part}" for n in (0, 3, 6, 8, 10) for part in ("weight", "bias")
    )


def test_the_cache_and_the_folder_give_the_same_numbers(hub, tmp_path):
    """Those of half precision, in which the folder's file is stored."""
    write_alexnet(hub / ALEXNET, 0.1)
    cached = find_backbone("alexnet", None)["features.0.bias"]
    (hub / ALEXNET).unlink()
    write_alexnet(tmp_path / "alexnet_features_fp16.pth", 0.1, torch.float16)
    assert torch.equal(cached, find_backbone("alexnet", tmp_path)["features.0.bias"])


def test_long_lrms_weights_are_checked_against_their_hash(hub, monkeypatch):
    asked = {}

    def download(url, file, hash_prefix=None, **_):
        asked[url] = hash_prefix
        raise RuntimeError("invalid hash value")

    monkeypatch.setattr("torch.hub.download_url_to_file", download)
    with pytest.raises(InputError, match=r"matconvnet_vgg19\.pt could not be downloaded"):
        find_backbone("matconvnet_vgg19", None, download=True)
    assert [len(digest) for digest in asked.values()] == [64]


def test_broken_files_and_files_with_other_content_are_refused(hub):
    (hub / ALEXNET).write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(InputError, match=r"7be5be79\.pth cannot be read"):
        find_backbone("alexnet", None)
    torch.save({"features.0.weight": torch.zeros(1)}, hub / ALEXNET)
    with pytest.raises(InputError, match=r"7be5be79\.pth has no features\.0\.weight of shape"):
        find_backbone("alexnet", None)


def test_the_option_to_download_reaches_every_user_of_backbones(composed):
    config = composed("paths.download=true", "paths.run=unused")

    def users(node):
        if isinstance(node, dict):
            if "_target_" in node and "backbone_dir" in node:
                yield node
            for value in node.values():
                yield from users(value)

    found = list(users(OmegaConf.to_container(config, resolve=True)))
    assert len(found) == 2  # LPIPS and the perceptual term
    assert all(node["download"] is True for node in found)
