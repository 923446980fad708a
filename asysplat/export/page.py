"""A scene as one HTML page, which opens from disk in any browser."""

import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import sha256
from html import escape
from pathlib import Path
from string import Template

import numpy as np
import torch

from asysplat.data.selection import evenly_spaced
from asysplat.errors import InputError
from asysplat.export.formats import packing, spz
from asysplat.export.importance import most_important
from asysplat.export.viewer_cameras import mean_up, quaternion
from asysplat.files import atomic_write
from asysplat.geometry import spherical_harmonics
from asysplat.rendering import INRIA
from asysplat.scene import Cameras, Gaussians

PAGE = ".html"
BLACK = (0.0, 0.0, 0.0)
FILES = Path(__file__).parent / "page_files"
SCRIPTS = ("scene.js", "camera.js", "renderer.js", "viewer.js")  # one module, in this order
SH_FACTORS = ("SH_C0", "Y1", "Y2", "Y2_0", "Y3_3", "Y3_2", "Y3_1", "Y3_0")
HALF_TURN = np.array([1.0, -1.0, -1.0])  # from our axes to SPZ's
FIRST_PART = 0.1  # fraction of the Gaussians that a page draws before it has the others
WEIGHED_VIEWS = 16  # most cameras whose images decide which they are
DIGITS = 9  # significant, of a camera's numbers: those of float32
# In JSON, what could end a script element or, in old browsers, a string.
UNSAFE = {ord(character): f"\\u{ord(character):04x}" for character in "<>&\u2028\u2029"}


def write_page(
    path: str | Path,
    gaussians: Gaussians,
    cameras: Cameras,
    names: Sequence[str] = (),
    title: str = "",
    background: Sequence[int | float] = BLACK,
    antialiased: bool = False,
    focus: Sequence[float] | None = None,
) -> None:
    """Write one scene and its viewer as one HTML file, which needs no server and no network.

    The page draws what `render` draws, of Gaussians as SPZ rounds them (see `write_spz`). The
    tenth that shows most stands first in the file, and is drawn once it has come.

    Args:
        path: the file, .html.
        gaussians: [N].
        cameras: [V], in the order of the path on which the page moves; it opens at the first.
        names: photographs' names, one a camera; empty: the page shows numbers.
        title: the page's title; empty: the file's name.
        background: RGB behind the Gaussians.
        antialiased: see `render`.
        focus: the point to orbit; None: where the middle of the picture shows a surface.

    Raises:
        InputError: another suffix, invalid Gaussians or cameras, another number of names, a
            background that is no color, or a file that cannot be written.

    Example:
        >>> from asysplat import open_photographs, read_gaussians
        >>> from asysplat.export import write_page
        >>> cameras = open_photographs("my_scene", height=64, views=4).inputs.cameras
        >>> write_page("scene.html", read_gaussians("scene.ply"), cameras)
    """
    path = Path(path)
    if path.suffix.lower() != PAGE:
        raise InputError(f"{path} is not the name of a page: give one that ends in {PAGE}.")
    if cameras.intrinsics.ndim != 3 or cameras.num_views == 0:
        raise InputError(
            f"write_page's cameras have the shape {tuple(cameras.intrinsics.shape)}: expected "
            "[V, 3, 3] of one scene, with one view or more."
        )
    if len(names) not in (0, cameras.num_views):
        raise InputError(
            f"write_page has {len(names)} names and {cameras.num_views} cameras: give one name "
            "for each, or none."
        )
    if len(background) != 3 or not all(0 <= value <= 1 for value in background):
        raise InputError(
            f"write_page's background is {background!r}: give red, green and blue, from 0 to 1."
        )
    cameras = cameras.map(lambda tensor: tensor.detach().cpu().double()).validate()
    settings = {
        "image": [cameras.width, cameras.height],
        "path": _path(cameras),
        "names": [str(name) for name in names],
        "up": (HALF_TURN * mean_up(cameras).numpy()).tolist(),
        "focus": None if focus is None else (HALF_TURN * focus).tolist(),
        "background": [float(value) for value in background],
        "defines": _defines(gaussians, antialiased),
    }
    first, rest = _parts(packing.prepare_for_export(gaussians), cameras)
    style, script = _read("style.css"), "".join(map(_read, SCRIPTS))
    page = Template(_read("page.html")).substitute(
        title=escape(title or path.stem),
        policy=_policy(style, script),
        style=style,
        settings=json.dumps(settings, separators=(",", ":")).translate(UNSAFE),
        first=first,
        rest=rest,
        worker=_read("worker.js"),
        script=script,
    )
    with atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8", newline="\n")


def _read(name: str) -> str:
    return (FILES / name).read_text(encoding="utf-8")


def _parts(gaussians: Gaussians, cameras: Cameras) -> tuple[str, str]:
    """Return the Gaussians that are drawn first, and the rest, if any, as SPZ in base64."""
    count = min(WEIGHED_VIEWS, cameras.num_views)
    chosen = cameras.select(evenly_spaced(range(cameras.num_views), count)).to(torch.float32)
    is_first = most_important(gaussians, FIRST_PART, chosen)
    parts = (gaussians.keep(mask) for mask in (is_first, ~is_first) if mask.any())
    first, *rest = (b64encode(spz.encode_spz(part)).decode() for part in parts)
    return first, "".join(rest)


def _defines(gaussians: Gaussians, antialiased: bool) -> str:
    floats = asdict(INRIA) | {"color_factor": spz.COLOR_FACTOR}
    floats |= {name: getattr(spherical_harmonics, name) for name in SH_FACTORS}
    integers = {"sh_count": gaussians.sh.shape[-2] - 1, "antialiased": int(antialiased)}
    pairs = [*((name, float(value)) for name, value in floats.items()), *integers.items()]
    return "".join(f"#define {name.upper()} {value}\n" for name, value in pairs)


def _path(cameras: Cameras) -> list[list[float]]:
    """Return each camera's center, quaternion wxyz and intrinsics fx, fy, cx, cy, in SPZ's axes."""
    centers = HALF_TURN * cameras.centers.numpy()
    quats = np.stack([quaternion(cameras, view) for view in range(cameras.num_views)])
    # A half turn around x, i, times wxyz.
    quats = np.stack((-quats[:, 1], quats[:, 0], -quats[:, 3], quats[:, 2]), 1)
    # q and -q are the same rotation: neighbors get the same sign, to be interpolated.
    flips = (quats[1:] * quats[:-1]).sum(1) < 0
    quats[1:] *= np.where(flips, -1, 1).cumprod()[:, None]
    intrinsics = cameras.intrinsics.numpy()[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    numbers = np.concatenate((centers, quats, intrinsics), 1)
    return [[float(f"{number:.{DIGITS}g}") for number in row] for row in numbers]


def _policy(style: str, script: str) -> str:
    """Return a Content Security Policy: these two and a thread of the page's own, no network."""

    def digest(text: str) -> str:
        return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"

    return (
        f"default-src 'none'; script-src {digest(script)}; style-src {digest(style)}; "
        "worker-src blob:; base-uri 'none'; form-action 'none'"
    )
