import json
import struct
from dataclasses import fields

import numpy as np
import pytest
import torch
from oracles import gltf_errors, splat_transform

from asysplat import render
from asysplat.errors import InputError
from asysplat.export import write_ply
from asysplat.export.formats.glb import read_glb, write_glb
from asysplat.geometry.motion import rotations, transform
from asysplat.scene import Gaussians

PREFIX = "KHR_gaussian_splatting:"


@pytest.fixture
def written(make_scene, tmp_path):
    """A scene of SH degree 1, and its file."""
    scene, _ = make_scene(dtype=torch.float32)
    write_glb(tmp_path / "scene.glb", scene)
    return scene, tmp_path / "scene.glb"


def parse(content):
    """The JSON and the buffer of a binary glTF file."""
    (size,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def join(document, buffer):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    chunks += struct.pack("<I", len(buffer)) + b"BIN\0" + buffer
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def change(file, edit):
    """Edit the JSON of a file."""
    document, buffer = parse(file.read_bytes())
    edit(document)
    file.write_bytes(join(document, buffer))


def check_equal(read, scene, **tolerances):
    for field in fields(Gaussians):
        expected = getattr(scene, field.name).float()
        if field.name == "quats":
            expected = torch.nn.functional.normalize(expected, dim=-1)
        torch.testing.assert_close(getattr(read, field.name), expected, **tolerances)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [1, 257])
def test_all_but_the_length_of_quats_comes_back_bit_by_bit(make_scene, tmp_path, degree, count):
    scene, _ = make_scene(count, degree=degree, dtype=torch.float32)
    write_glb(tmp_path / "scene.glb", scene)
    read = read_glb(tmp_path / "scene.glb")
    check_equal(read, scene)
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(read, name), getattr(scene, name)), name
    content = (tmp_path / "scene.glb").read_bytes()
    write_glb(tmp_path / "scene.glb", scene)
    assert (tmp_path / "scene.glb").read_bytes() == content


def test_extreme_values_come_back(tmp_path):
    scene = Gaussians(
        means=torch.tensor([[1e6, 5, 0], [-1e6, 5, 1e-20]]),
        quats=torch.tensor([[1e-3, 0, 0, 0], [0, 0, -9, 0]]),
        scales=torch.tensor([[1e-10, 1, 1e3], [1e3, 1e3, 1e3]]),
        opacities=torch.tensor([1e-30, 1]),
        sh=torch.tensor([[[-50.0, 0, 50]], [[0, 0, 0]]]),
    )
    write_glb(tmp_path / "scene.glb", scene)
    check_equal(read_glb(tmp_path / "scene.glb"), scene, rtol=0, atol=0)


@pytest.mark.parametrize("degree", range(4))
def test_the_validator_finds_no_error(make_scene, tmp_path, degree):
    scene, _ = make_scene(5, degree=degree)
    write_glb(tmp_path / "scene.glb", scene)
    # It knows no names of attributes of extensions that it lacks.
    known = f"Invalid attribute name. /meshes/0/primitives/0/attributes/{PREFIX}"
    assert [e for e in gltf_errors(tmp_path / "scene.glb") if not e.startswith(known)] == []


@pytest.mark.parametrize("degree", range(4))
def test_files_of_splat_transform_are_read(make_scene, tmp_path, degree):
    scene, _ = make_scene(50, degree=degree, dtype=torch.float32)
    write_ply(tmp_path / "scene.ply", scene)
    splat_transform(tmp_path / "scene.ply", tmp_path / "other.glb")
    read = read_glb(tmp_path / "other.glb")
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(read, name), getattr(scene, name))
    # Axes of a Gaussian may point the other way.
    product = rotations(read.quats).mT @ rotations(scene.quats)
    torch.testing.assert_close(product.abs(), torch.eye(3).expand(50, 3, 3), rtol=0, atol=1e-5)


def test_points_have_the_linear_colors_of_the_gaussians(written):
    scene, file = written
    document, buffer = parse(file.read_bytes())
    index = document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    start = document["bufferViews"][index]["byteOffset"]
    rgba = np.frombuffer(buffer, np.uint8, 4 * scene.num_gaussians, start).reshape(-1, 4) / 255
    srgb = (0.5 + 0.28209479 * scene.sh[:, 0]).clamp(0, 1).numpy()
    encoded = np.where(rgba[:, :3] > 0.0031308, 1.055 * rgba[:, :3] ** (1 / 2.4) - 0.055, 0)
    bright = srgb > 0.2
    assert bright.any() and np.abs(encoded - srgb)[bright].max() < 0.01
    assert np.abs(rgba[:, 3] - scene.opacities.numpy()).max() < 0.002


def test_nodes_move_turn_and_scale(make_scene, tmp_path):
    scene, cameras = make_scene(degree=3, dtype=torch.float32)
    write_glb(tmp_path / "scene.glb", scene)
    turn = [0.5, -0.5, 0.5, 0.5]

    def edit(document):
        document["nodes"] = [{"mesh": 0, "rotation": turn, "scale": [2.0, 2.0, 2.0]}]
        matrix = torch.eye(4)
        matrix[:3, 3] = torch.tensor([1.0, 2, 3])
        document["nodes"].append({"children": [0], "matrix": matrix.T.flatten().tolist()})

    change(tmp_path / "scene.glb", edit)
    read = read_glb(tmp_path / "scene.glb")
    # The file has glTF's axes, ours turned around z.
    x, y, z = scene.means.unbind(1)
    expected = glb_turn(torch.stack((-x, -y, z), 1), turn) * 2 + torch.tensor([1.0, 2, 3])
    expected = expected * torch.tensor([-1.0, -1, 1])
    torch.testing.assert_close(read.means, expected)
    # A camera that moves along renders the same image, whatever turned.
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, 3] = torch.tensor([-1.0, -2, 3])
    flip = torch.diag(torch.tensor([-1.0, -1, 1])).double()
    motion[:3, :3] = flip @ glb_turn(torch.eye(3), turn).double().T @ flip
    same = transform(scene.scale_by(2.0), motion)
    for image in ("image", "depth"):
        a, b = (getattr(render(g, cameras), image) for g in (read, same))
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def glb_turn(points, xyzw):
    """Rotate points [N, 3] by a quaternion: v + 2 w (q x v) + 2 q x (q x v)."""
    q, w = torch.tensor(xyzw[:3]).expand_as(points), xyzw[3]
    cross = torch.linalg.cross(q, points)
    return points + 2 * w * cross + 2 * torch.linalg.cross(q, cross)


def test_integers_and_strides_are_read(tmp_path):
    count = 3
    columns = [("p", "<f4", 3), ("q", "i1", 4), ("s", "<u2", 3), ("o", "u1"), ("pad", "u1")]
    rows = np.zeros(count, [*columns, ("c", "<f4", 3)])
    rows["p"], rows["q"] = np.arange(9).reshape(3, 3), [0, 0, -127, 127]
    rows["s"], rows["o"], rows["c"] = 32768, [0, 51, 255], 0.25
    layout = {"POSITION": ("p", 5126, 3, False), "ROTATION": ("q", 5120, 4, True)}
    layout |= {"SCALE": ("s", 5123, 3, True), "OPACITY": ("o", 5121, 1, True)}
    layout |= {"SH_DEGREE_0_COEF_0": ("c", 5126, 3, False)}
    attributes, accessors = {}, []
    for index, (name, (key, component, size, normalized)) in enumerate(layout.items()):
        attributes[name if name == "POSITION" else PREFIX + name] = index
        accessors.append(
            {
                "bufferView": 0,
                "byteOffset": rows.dtype.fields[key][1],
                "componentType": component,
                "normalized": normalized,
                "count": count,
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[size],
            }
        )
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {PREFIX[:-1]: splats}}
    view = {"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.dtype.itemsize}
    document = {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    document |= {"accessors": accessors, "bufferViews": [view], "buffers": [{"byteLength": 1}]}
    (tmp_path / "other.glb").write_bytes(join(document, rows.tobytes()))
    read = read_glb(tmp_path / "other.glb")
    assert read.means.tolist() == [[0, -1, 2], [-3, -4, 5], [-6, -7, 8]]
    torch.testing.assert_close(read.quats[0], torch.tensor([0.5**0.5, 0, 0, -(0.5**0.5)]))
    torch.testing.assert_close(read.scales, torch.full((3, 3), 32768 / 65535))
    torch.testing.assert_close(read.opacities[1:], torch.tensor([0.2, 1]))
    assert 0 < read.opacities[0] < 1e-30
    assert (read.sh == 0.25).all()


SPLATS = ("meshes", 0, "primitives", 0)


@pytest.mark.parametrize(
    ("place", "key", "value", "message"),
    [
        ((), "extensionsRequired", ["KHR_draco"], "needs the extension KHR_draco"),
        (("nodes", 0), "scale", [1, 1, 2], "nodes stretch, shear or mirror"),
        (SPLATS, "mode", 4, "expected uncompressed points"),
        (("accessors", 0), "sparse", {"count": 1}, "sparse, compressed"),
    ],
)
def test_what_is_not_read_is_refused(written, place, key, value, message):
    def edit(document):
        for step in place:
            document = document[step]
        document[key] = value

    change(written[1], edit)
    with pytest.raises(InputError, match=rf"scene\.glb.*{message}"):
        read_glb(written[1])
