"""`python -m asysplat.data.disparity`: its maps, and the training that reads them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.data import ProceduralScene, SceneOptions, files_data, open_scene
from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.data.disparity import LEVELS, map_folder, map_name
from asysplat.data.disparity.__main__ import main, shrink
from asysplat.data.disparity.network import DepthAnything, network_size
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.training.losses.disparity import reference_disparities

HEIGHT, WIDTH, FRAMES = 24, 32, 12


def red(photograph):
    """Replaces the network: red is near, at twice the image's size."""
    return photograph[..., 0].repeat(2, 0).repeat(2, 1).astype(np.float32) / 100 - 1


@pytest.fixture(scope="module")
def views():
    return ProceduralScene(1, HEIGHT, WIDTH, num_images=40, places="rooms").views(range(FRAMES))


@pytest.fixture
def scene(views, tmp_path):
    folder = tmp_path / "data" / "room"
    write_transforms(views, folder)
    return folder


@pytest.fixture
def command(tmp_path, capsys):
    """Runs the command without a network; maps go to tmp_path/maps by default."""

    def run(scene, *options, estimate=red):
        place = [] if "--beside" in options else ["--folder", str(tmp_path / "maps")]
        code = main([str(scene), *place, *options], estimate)
        return code, *capsys.readouterr()

    return run


def snapshot(folder):
    return {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.rglob("*") if p.is_file()}


def test_maps_are_written_outside_of_the_data_and_read(command, scene, views, tmp_path):
    before = snapshot(scene)
    code, out, _ = command(scene)
    folder = map_folder(scene, tmp_path / "maps")
    assert code == 0 and f"{FRAMES} maps written, 0 were there: {folder}" in out
    assert len(list(folder.iterdir())) == FRAMES and snapshot(scene) == before

    assert open_scene(scene, SceneOptions(HEIGHT, WIDTH)).views([0]).disparities is None
    options = SceneOptions(HEIGHT, WIDTH, disparities=tmp_path / "maps")
    found = open_scene(scene, options).views([3, 0])
    for disparity, image in zip(found.disparities, found.images[:, 0], strict=True):
        assert (disparity.min(), disparity.max()) == (1, LEVELS)
        near = (image - image.min()) / (image.max() - image.min())
        torch.testing.assert_close((disparity - 1) / (LEVELS - 1), near, atol=1 / LEVELS, rtol=0)
    torch.testing.assert_close(found.depths, views.depths[[3, 0]], atol=1e-3, rtol=0)


def test_a_second_call_continues(command, scene, tmp_path):
    def stops(photograph, calls=[]):  # noqa: B006
        calls.append(photograph)
        if len(calls) > 5:
            raise KeyboardInterrupt
        return red(photograph)

    with pytest.raises(KeyboardInterrupt):
        command(scene, estimate=stops)
    folder = map_folder(scene, tmp_path / "maps")
    first = snapshot(folder)
    assert len(first) == 5  # each whole, and nothing else
    some = open_scene(scene, SceneOptions(HEIGHT, WIDTH, disparities=tmp_path / "maps"))
    known = some.views(range(FRAMES)).disparities.flatten(1).any(1)
    assert known.sum() == 5  # 0 where unknown

    _, out, _ = command(scene)
    assert f"{FRAMES - 5} maps written, 5 were there" in out
    assert first.items() <= snapshot(folder).items() and len(snapshot(folder)) == FRAMES
    assert "0 maps written, 12 were there" in command(scene, estimate=stops)[1]


def test_maps_are_inside_the_data_only_with_beside(command, scene, tmp_path):
    code, _, said = command(scene, "--folder", str(scene / "maps"))  # the last one counts
    assert code == 2 and "lies in the data set" in said and not (scene / "maps").exists()
    code, out, _ = command(scene.parent, "--beside")
    assert code == 0 and str(scene / "disparities") in out
    assert len(list((scene / "disparities").iterdir())) == FRAMES
    read = open_scene(scene, SceneOptions(HEIGHT, WIDTH, disparities=tmp_path / "none")).views([1])
    assert read.disparities.max() == LEVELS


def test_a_map_of_another_image_is_refused(command, scene, tmp_path):
    command(scene)
    sequence = open_scene(scene, SceneOptions(HEIGHT, WIDTH, disparities=tmp_path / "maps"))
    image = sequence.scene.images[2].file
    path = map_folder(scene, tmp_path / "maps") / map_name(image, scene)
    Image.fromarray(np.ones((20, 40), np.uint16)).save(path)
    with pytest.raises(InputError, match=r"is 40 x 20 and .* 32 x 24: delete it, and estimate"):
        sequence.views([2])
    assert sequence.views([1]).disparities is not None


def test_training_reads_the_maps(command, scene, tmp_path):
    """Cropped with the images, in batches, and before the data's own depths."""
    command(scene)
    sizes = {"height": 16, "width": 16, "window": (6, 12), "inputs": 2, "targets": 2}
    loading = {"batch_size": 1, "num_workers": 0, "seed": 0, "steps_per_epoch": 1}
    data = files_data(
        root=str(scene), name="room", disparities=str(tmp_path / "maps"), **sizes, **loading
    )
    batch = collate([TrainingTasks(data)[0]] * 2)
    targets = batch["targets"]
    assert targets.depths is not None and targets.disparities.shape == (2, 2, 16, 16)
    assert torch.equal(reference_disparities(targets), targets.disparities)


def test_maps_and_network_inputs_keep_the_proportions():
    assert shrink(np.zeros((518, 924), np.float32), 540, 960).shape == (272, 484)
    assert shrink(np.zeros((518, 700), np.float32), 20, 27).shape == (20, 27)
    assert network_size(540, 960, 14) == (518, 924) and network_size(960, 540, 14) == (924, 518)


def test_depth_anything_by_way_of_transformers_writes_maps(command, scene, tmp_path):
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
    code, out, said = command(scene, "--model", str(model), estimate=None)
    assert code == 0 and f"{FRAMES} maps written" in out, said
    read = open_scene(scene, SceneOptions(HEIGHT, WIDTH, disparities=tmp_path / "maps")).views([0])
    assert read.disparities.unique().numel() > 100


class Network(torch.nn.Module):
    """Returns its red input."""

    config = SimpleNamespace(patch_size=14)

    def forward(self, pixel_values):
        self.given = pixel_values
        return SimpleNamespace(predicted_depth=pixel_values[:, 0])


def test_the_network_gets_whole_patches_normalized_as_imagenet_s():
    network = Network()
    photograph = np.full((100, 150, 3), (255, 0, 128), np.uint8)
    found = DepthAnything(network, torch.device("cpu"))(photograph)
    assert network.given.shape == (1, 3, 518, 784) and found.shape == (518, 784)
    expected = [(1 - 0.485) / 0.229, -0.456 / 0.224, (128 / 255 - 0.406) / 0.225]
    torch.testing.assert_close(network.given[0, :, 9, 9], torch.tensor(expected))
    assert found.dtype == np.float32
