"""`asysplat prepare --disparities`: its maps, and the training that reads them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from asysplat.data import ProceduralScene, SceneOptions, files_data, open_scene
from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.data.prepare import __main__ as command
from asysplat.data.prepare import scene_files
from asysplat.data.prepare.disparity import LEVELS, DepthAnything, network_size, shrink
from asysplat.data.write import write_transforms
from asysplat.training.losses.disparity import reference_disparities

HEIGHT, WIDTH, FRAMES = 24, 32, 12


def red(photographs):
    """Replaces the network: red is near, at twice the images' size."""
    return photographs[..., 0].repeat(2, 1).repeat(2, 2).astype(np.float32) / 100 - 1


@pytest.fixture(scope="module")
def views():
    return ProceduralScene(1, HEIGHT, WIDTH, num_images=40, places="rooms").views(range(FRAMES))


@pytest.fixture
def scene(views, tmp_path):
    folder = tmp_path / "data" / "room"
    write_transforms(views, folder)
    return folder


@pytest.fixture
def out(tmp_path, monkeypatch):
    """Runs the command, by default with `red` in place of the network."""

    def run(scene, *options, estimate=red):
        if estimate is not None:
            for module in (command, scene_files):
                monkeypatch.setattr(module, "load_depth_anything", lambda *_, **__: estimate)
        words = [str(scene), str(tmp_path / "out"), "--sizes", "24x32", "--workers", "1"]
        arguments = command.read_arguments([*words, "--disparities", *options])
        assert command.main(arguments) == 0
        return tmp_path / "out" / "24x32" / f"{scene.name}.safetensors"

    return run


def test_disparities_are_prepared(out, scene, views):
    found = open_scene(out(scene), SceneOptions(HEIGHT, WIDTH)).views([3, 0])
    for disparity, image in zip(found.disparities, views.images[[3, 0], 0], strict=True):
        assert (disparity.min(), disparity.max()) == (1, LEVELS)
        near = (image - image.min()) / (image.max() - image.min())
        torch.testing.assert_close((disparity - 1) / (LEVELS - 1), near, atol=2.0 / 255, rtol=0)
    assert found.depths is not None
    assert open_scene(scene, SceneOptions(HEIGHT, WIDTH)).views([0]).disparities is None


def test_training_reads_the_maps(out, scene):
    """Cropped with the images, in batches, and before the data's own depths."""
    sizes = {"height": 16, "width": 16, "window": (6, 12), "inputs": 2, "targets": 2}
    loading = {"batch_size": 1, "num_workers": 0, "seed": 0, "steps_per_epoch": 1}
    data = files_data(root=str(out(scene)), name="room", **sizes, **loading)
    batch = collate([TrainingTasks(data)[0]] * 2)
    targets = batch["targets"]
    assert targets.depths is not None and targets.disparities.shape == (2, 2, 16, 16)
    assert torch.equal(reference_disparities(targets), targets.disparities)


def test_maps_and_network_inputs_keep_the_proportions():
    assert shrink(np.zeros((518, 924), np.float32), 540, 960).shape == (272, 484)
    assert shrink(np.zeros((518, 700), np.float32), 20, 27).shape == (20, 27)
    assert network_size(540, 960, 14) == (518, 924) and network_size(960, 540, 14) == (924, 518)


def test_depth_anything_by_way_of_transformers_estimates(out, scene, tmp_path):
    """With random weights of a tiny network."""
    transformers = pytest.importorskip("transformers", reason="needs transformers")
    backbone = transformers.Dinov2Config(
        **{"hidden_size": 12, "num_hidden_layers": 4, "num_attention_heads": 2, "mlp_ratio": 1},
        **{"image_size": 28, "patch_size": 14, "reshape_hidden_states": False},
        out_indices=[1, 2, 3, 4],
    )
    config = transformers.DepthAnythingConfig(
        **{"backbone_config": backbone, "reassemble_hidden_size": 12, "patch_size": 14},
        **{"neck_hidden_sizes": [4, 4, 4, 4], "fusion_hidden_size": 4, "head_hidden_size": 4},
    )
    model = tmp_path / "model"
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(model)
    read = open_scene(out(scene, str(model), estimate=None), SceneOptions(HEIGHT, WIDTH)).views([0])
    assert read.disparities.unique().numel() > 100


class Network(torch.nn.Module):
    """Returns its red input."""

    config = SimpleNamespace(patch_size=14)

    def forward(self, pixel_values):
        self.given = pixel_values
        return SimpleNamespace(predicted_depth=pixel_values[:, 0])


def test_the_network_gets_whole_patches_normalized_as_imagenet_s():
    network = Network()
    photographs = np.full((2, 100, 150, 3), (255, 0, 128), np.uint8)
    found = DepthAnything(network, torch.device("cpu"))(photographs)
    assert network.given.shape == (2, 3, 518, 784) and found.shape == (2, 518, 784)
    expected = [(1 - 0.485) / 0.229, -0.456 / 0.224, (128 / 255 - 0.406) / 0.225]
    torch.testing.assert_close(network.given[0, :, 9, 9], torch.tensor(expected))
    assert found.dtype == np.float32
