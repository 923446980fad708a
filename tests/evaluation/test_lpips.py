import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.models import alexnet

from asysplat.errors import InputError
from asysplat.evaluation.backbones import VGGFeatures, find_backbone
from asysplat.evaluation.lpips import load_lpips, lpips_distance


@pytest.fixture
def empty_hub(tmp_path, monkeypatch):
    """torch's hub cache, empty; any download fails."""

    def refuse(*_args, **_kwargs):
        raise AssertionError("a download was attempted")

    monkeypatch.setattr("urllib.request.urlopen", refuse)
    monkeypatch.setattr("torch.hub.download_url_to_file", refuse)
    before = torch.hub.get_dir()
    torch.hub.set_dir(tmp_path / "hub")
    checkpoints = tmp_path / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    yield checkpoints
    torch.hub.set_dir(before)


@pytest.fixture
def weights(shared, empty_hub):
    folder = shared / "weights"
    if not (folder / "vgg16_features_fp16.pth").is_file():
        pytest.skip(f"{folder} has no weights: set ASYSPLAT_SHARED")
    return folder


def write_alexnet(path, value, dtype=torch.float32):
    """AlexNet's weights, all equal to `value`; stored as one number a tensor."""
    with torch.device("meta"):
        shapes = {key: tensor.shape for key, tensor in alexnet().state_dict().items()}
    path.parent.mkdir(exist_ok=True)
    state = {key: torch.tensor(value, dtype=dtype).expand(shape) for key, shape in shapes.items()}
    torch.save(state, path)


def read_image(path):
    return torch.from_numpy(np.array(Image.open(path).convert("RGB"))).permute(2, 0, 1) / 255


def test_without_weights_there_is_no_lpips_and_no_download(empty_hub, tmp_path):
    assert load_lpips("alex", None) is None
    assert load_lpips("vgg", tmp_path) is None


def test_hub_cache_comes_first_and_only_features_are_kept_as_fp32(empty_hub, tmp_path):
    folder = tmp_path / "weights"
    write_alexnet(folder / "alexnet_features_fp16.pth", 2.0, torch.float16)
    found = find_backbone("alexnet", folder)
    assert found["features.0.bias"].dtype == torch.float32
    assert found["features.0.bias"].unique().tolist() == [2.0]
    write_alexnet(empty_hub / "alexnet-owt-7be5be79.pth", 1.0)
    found = find_backbone("alexnet", folder)
    assert found["features.10.weight"].unique().tolist() == [1.0]
    assert sorted(found) == sorted(
        f"features.{n}.{part}" for n in (0, 3, 6, 8, 10) for part in ("weight", "bias")
    )


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 cut short"])
def test_a_broken_file_is_named(empty_hub, content):
    path = empty_hub / "vgg16-397923af.pth"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"vgg16-397923af\.pth cannot be read"):
        find_backbone("vgg16", None)


@pytest.mark.parametrize("content", [[1, 2], {"features.0.weight": torch.zeros(1)}])
def test_a_file_with_something_else_is_named(empty_hub, content):
    torch.save(content, empty_hub / "alexnet-owt-7be5be79.pth")
    with pytest.raises(InputError, match=r"7be5be79\.pth has no features\.0\.weight of shape"):
        find_backbone("alexnet", None)


@pytest.mark.parametrize("net, expected", [("alex", [0.7219, 0.1376]), ("vgg", [0.5686, 0.4217])])
def test_lpips_of_the_reference_images(weights, net, expected, capsys):
    state = torch.get_rng_state()
    network = load_lpips(net, weights)
    assert torch.equal(torch.get_rng_state(), state)
    assert capsys.readouterr().out == ""
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())

    images = weights / "reference_images"
    reference = read_image(images / "ex_ref.png").expand(1, 2, 3, 64, 64)
    distorted = torch.stack([read_image(images / f"ex_p{i}.png") for i in range(2)])[None]
    distances = lpips_distance(network, distorted, reference)
    torch.testing.assert_close(distances, torch.tensor([expected]), atol=1e-4, rtol=0)
    assert lpips_distance(network, reference, reference).tolist() == [[0, 0]]


def test_vgg_features_are_the_five_named_activations(weights):
    backbone = find_backbone("vgg16", weights)
    features = VGGFeatures("vgg16", backbone, (3, 8, 15, 22, 29), (0.229, 0.224, 0.225))
    assert not any(parameter.requires_grad for parameter in features.parameters())
    images = torch.rand(2, 3, 32, 48, requires_grad=True)
    activations = features(images)
    shapes = [tuple(a.shape) for a in activations]
    channels = (64, 128, 256, 512, 512)
    assert shapes == [(2, c, 32 >> i, 48 >> i) for i, c in enumerate(channels)]

    # ReLU 1_2 by hand; a gradient reaches the images.
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    std = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    x = (images - mean) / std
    for n in (0, 2):
        weight, bias = backbone[f"features.{n}.weight"], backbone[f"features.{n}.bias"]
        x = torch.nn.functional.conv2d(x, weight, bias, padding=1).relu()
    torch.testing.assert_close(activations[0], x)
    activations[-1].sum().backward()
    assert images.grad.abs().sum() > 0
