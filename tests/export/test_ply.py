"""Gaussians as PLY, against plyfile and the way INRIA's code reads them."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from asysplat.errors import InputError
from asysplat.export import read_ply, write_ply
from asysplat.rendering import render
from asysplat.scene import Gaussians


@pytest.fixture
def scene(make_scene):
    return make_scene(count=12, degree=3, dtype=torch.float32)[0]


@pytest.fixture
def written(scene, tmp_path):
    write_ply(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


def assert_same(one: Gaussians, other: Gaussians):
    other = replace(other, quats=torch.nn.functional.normalize(other.quats, dim=-1))
    for field in fields(Gaussians):
        ours, theirs = getattr(one, field.name), getattr(other, field.name)
        assert ours.dtype == torch.float32
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6)


def as_inria_reads(path) -> Gaussians:
    vertex = PlyData.read(path)["vertex"]

    def columns(start):
        names = [name for name in vertex.data.dtype.names if name.startswith(start)]
        names.sort(key=lambda name: int(name.split("_")[-1]))
        return torch.tensor(np.stack([vertex[name] for name in names], 1))

    return Gaussians(
        means=torch.tensor(np.stack((vertex["x"], vertex["y"], vertex["z"]), 1)),
        quats=torch.nn.functional.normalize(columns("rot_")),
        scales=columns("scale_").exp(),
        opacities=torch.tensor(vertex["opacity"]).sigmoid(),
        sh=torch.cat((columns("f_dc_")[..., None], columns("f_rest_").unflatten(1, (3, -1))), 2).mT,
    )


def rewritten(path, change=lambda rows: rows, **kwargs):
    """The same file after a change of its vertices, in another format."""
    rows = change(PlyData.read(path, mmap=False)["vertex"].data)
    PlyData([PlyElement.describe(rows, "vertex")], **kwargs).write(path)
    return path


def without(*names):
    def change(rows):
        return np.array(
            rows[[name for name in rows.dtype.names if name not in names]].tolist(),
            [kind for kind in rows.dtype.descr if kind[0] not in names],
        )

    return change


@settings(max_examples=30)
@given(
    st.floats(2**-100, 1, width=32),
    st.floats(2**-20, 2**20, width=32),
    st.floats(-(2**60), 2**60, width=32),
)
@example(1e-38, 1.0, 0.0)
@example(1 - 2**-24, 1.0, 0.0)
@example(1.0, 1.0, 0.0)  # beyond the logit of float32
def test_ply_gives_back_any_number(tmp_path_factory, opacity, scale, number):
    path = tmp_path_factory.getbasetemp() / "any.ply"
    scene = Gaussians(
        torch.full((2, 3), number),
        torch.tensor([[0.0, 0, 1, 0]]).repeat(2, 1),
        torch.full((2, 3), scale),
        torch.full((2,), opacity),
        torch.full((2, 4, 3), number),
    )
    write_ply(path, scene)
    assert np.isfinite(PlyData.read(path)["vertex"]["opacity"]).all()
    assert_same(read_ply(path), scene)


def test_opacities_and_scales_that_round_to_zero_can_still_be_rendered(written):
    for name in ("opacity", "scale_0"):
        rewritten(written, put(name, -200))
    read = read_ply(written)
    assert 0 < read.opacities[3] < 1e-30 and 0 < read.scales[3, 0] < 1e-30


def test_ply_files_have_inrias_properties_in_their_order(written, scene):
    header = written.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    # What a renderer needs to know, in the words that splat-transform reads.
    assert header[2:4] == ["comment antialiased 0", "comment sh_degree 3"]
    assert header[4:] == ["element vertex 12", *(f"property float {name}" for name in names)]
    vertex = PlyData.read(written)["vertex"]
    # All of red, then all of green, then all of blue.
    assert vertex["f_rest_0"][5] == scene.sh[5, 1, 0]
    assert vertex["f_rest_14"][5] == scene.sh[5, 15, 0]
    assert vertex["f_rest_15"][5] == scene.sh[5, 1, 1]
    assert vertex["f_rest_44"][5] == scene.sh[5, 15, 2]


def test_ply_files_render_as_what_inria_s_code_reads(written, make_scene):
    scene, cameras = make_scene(count=12, views=2, degree=3, dtype=torch.float32)
    theirs = as_inria_reads(written)
    assert_same(theirs, scene)
    image = render(scene, cameras, backend="reference").image
    for other in (theirs, read_ply(written)):
        torch.testing.assert_close(render(other, cameras, backend="reference").image, image)
    interleaved = theirs.sh[:, 1:].mT.reshape(12, 15, 3)
    wrong = replace(theirs, sh=torch.cat((theirs.sh[:, :1], interleaved), 1))
    assert (render(wrong, cameras, backend="reference").image - image).abs().max() > 0.01


def test_text_and_big_endian_ply_files_are_read(written, scene):
    rewritten(written, byte_order=">")
    assert_same(read_ply(written), scene)
    rewritten(written, text=True)
    assert_same(read_ply(written), scene)
    written.write_bytes(written.read_bytes().replace(b"\n", b"\r\n"))  # of Windows
    assert_same(read_ply(written), scene)


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_order_extra_properties_and_other_elements_of_ply_do_not_matter(written, scene, kind):
    rows = PlyData.read(written, mmap=False)["vertex"].data
    kinds = [("label", "u1"), *reversed(rows.dtype.descr), ("score", "f8")]
    shuffled = np.zeros(len(rows), kinds)
    for name in rows.dtype.names:
        shuffled[name] = rows[name]
    before = np.array([(1, 2.5), (2, 3.5)], [("number", "i2"), ("value", "f4")])
    after = np.empty(1, [("vertex_indices", object)])
    after["vertex_indices"][0] = np.arange(3, dtype=np.int32)
    parts = {"camera": before, "vertex": shuffled, "face": after}
    elements = [PlyElement.describe(rows, name) for name, rows in parts.items()]
    PlyData(elements, text=kind == "ascii", comments=["by another program"]).write(written)
    assert_same(read_ply(written), scene)


def put(name, value):
    def change(rows):
        rows[name][3] = value
        return rows

    return change


CHANGES = [
    (without("opacity"), "no property opacity"),
    (without("f_rest_7"), "no property f_rest_7|cannot be read"),
    (put("f_rest_9", np.nan), r"Gaussians\.sh\[3\] holds NaN"),
    (lambda rows: rows[:0], "has no vertices"),
]


def test_ply_files_that_hold_no_scene_are_refused(written):
    stored = written.read_bytes()
    for change, message in CHANGES:
        written.write_bytes(stored)
        rewritten(written, change)
        with pytest.raises(InputError, match=rf"scene\.ply.*{message}"):
            read_ply(written)
