"""Downloads of ImageNet weights: asked for, into torch's hub cache, once; no test has a network."""

from urllib.error import URLError

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torchvision.models import alexnet

from asysplat.errors import InputError
from asysplat.evaluation import backbones
from asysplat.evaluation.backbones import find_backbone


@pytest.fixture
def network(tmp_path, monkeypatch):
    """Addresses that were asked; each answers with torchvision's file of zeros, as stored."""
    asked = []
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))

    def download(url, file, *_, **__):
        asked.append(url)
        with torch.device("meta"):
            shapes = {key: tensor.shape for key, tensor in alexnet().state_dict().items()}
        torch.save({key: torch.zeros(1).expand(shape) for key, shape in shapes.items()}, file)

    monkeypatch.setattr("torch.hub.download_url_to_file", download)
    return asked


def test_it_is_downloaded_once_and_only_where_asked(network):
    assert find_backbone("alexnet", None) is None
    assert not network
    found = find_backbone("alexnet", None, download=True)
    again = find_backbone("alexnet", None, download=True)
    assert len(network) == 1 and network[0].startswith("https://") and "alexnet" in network[0]
    assert found.keys() == again.keys() == find_backbone("alexnet", None).keys()
    assert found["features.0.weight"].shape == (64, 3, 11, 11)


def test_a_folder_s_file_needs_no_download(network, tmp_path):
    backbones.get_model_weights("alexnet").IMAGENET1K_V1.get_state_dict(progress=False)
    (tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth").rename(
        tmp_path / "alexnet_features_fp16.pth"
    )
    assert find_backbone("alexnet", tmp_path, download=True)
    assert len(network) == 1


def test_the_option_reaches_everything_that_looks_for_backbones(repository):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        config = compose("train", ["paths.download=true", "paths.run=unused"])

    def looking(node):
        if isinstance(node, dict):
            if "_target_" in node and "backbone_dir" in node:
                yield node
            for value in node.values():
                yield from looking(value)

    found = list(looking(OmegaConf.to_container(config, resolve=True)))
    assert len(found) == 2  # LPIPS and the perceptual term
    assert all(node["download"] is True for node in found)


@pytest.mark.parametrize("error", [URLError("no route"), RuntimeError("invalid hash value")])
def test_a_download_that_fails_is_one_sentence(network, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("torch.hub.download_url_to_file", fail)
    with pytest.raises(InputError, match=r"alexnet.* could not be downloaded \(.*paths\.download"):
        find_backbone("alexnet", None, download=True)
