import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.evaluation.lpips import load_lpips, lpips_distance


def read_image(path):
    return torch.from_numpy(np.array(Image.open(path).convert("RGB"))).permute(2, 0, 1) / 255


@pytest.mark.parametrize("net, expected", [("alex", [0.7219, 0.1376]), ("vgg", [0.5686, 0.4217])])
def test_lpips_of_the_reference_images(shared, net, expected, capsys, monkeypatch, tmp_path):
    weights = shared / "weights"
    if not (weights / "vgg16_features_fp16.pth").is_file():
        pytest.skip(f"{weights} has no weights: set ASYSPLAT_SHARED")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
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
