"""Read what another system made of the scenes of a data set: a file of Gaussians for each."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from asysplat.data.readers import colmap, transforms
from asysplat.data.sequence import MIN_EXTENT, FileSequence, ImageSequence
from asysplat.errors import InputError, list_names
from asysplat.export.gaussians import READERS, read_gaussians
from asysplat.geometry.motion import fit_similarity, transform
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

CAMERAS_SUFFIX = ".cameras.json"  # of <scene>.cameras.json beside <scene>.ply, a transforms.json
MODEL = "sparse/0"  # COLMAP model in the folder <scene>/, in place of <scene>.cameras.json
# Files that Long-LRM writes, as <scene>/gaussians_001.ply and with numpy.savetxt beside it:
# https://github.com/arthurhero/Long-LRM/blob/main/model/llrm.py (save_evaluation_results)
LONG_LRM, MOTION, SCALE = "gaussians_*.ply", "pos_avg_inv.txt", "scene_scale.txt"
MAX_RESIDUAL = 0.1  # greatest residual of fitted cameras, as a fraction of their spread
# A view shows nothing if it has Gaussians in a smaller fraction of its pixels, at a height and
# width of COVERAGE_SIZE; half of the views must show something.
MIN_COVERAGE, COVERAGE_SIZE = 0.01, 64
VISIBLE = 0.05  # alpha of a pixel that has Gaussians
NamedPoses = list[tuple[str, Float[ndarray, "4 4"]]]


@dataclass(frozen=True)
class SceneFile:
    """A file of Gaussians and the data's images of its scene."""

    path: Path
    sequence: ImageSequence

    def read(self) -> tuple[Gaussians, float | None]:
        """Read the Gaussians in float64 in the data's world, to which their cameras are fitted.

        Returns:
            The Gaussians; the root mean square residual of the fit, as a fraction of the spread of
            the cameras, or None without cameras: the file is then in the data's world, or in
            Long-LRM's frame, see `_read_long_lrm`.
        """
        cameras = self._cameras()
        if cameras is None and self.path.with_name(MOTION).is_file():
            return self._read_long_lrm(), None
        if cameras is None:
            return read_gaussians(self.path, world_origin(self.sequence), torch.float64), None
        where, poses = cameras
        source, target = self._matched(where, poses)
        origin = source[:, :3, 3].mean(0)  # float32 may not resolve the file's own coordinates
        source[:, :3, 3] -= origin
        points, spread = _points(target)
        motion, scale = fit_similarity(_points(source)[0], points)
        fitted = _points(source)[0] @ motion[:3, :3].mT + motion[:3, 3]
        residual = (scale * fitted - points).square().sum(-1).mean().sqrt().item() / spread
        if not residual <= MAX_RESIDUAL:
            raise InputError(
                f"{where}: its {len(source)} cameras differ from those of {self.sequence.name} by "
                f"{residual:.0%} of their spread, after rotation, translation and scale; at most "
                f"{MAX_RESIDUAL:.0%} is accepted: give the cameras of the same images, with the "
                "axes of their format."
            )
        gaussians = read_gaussians(self.path, origin.tolist(), torch.float64)
        return transform(gaussians, motion).scale_by(scale), residual

    def _read_long_lrm(self) -> Gaussians:
        """Read Gaussians at x' = SCALE (MOTION x), where x is in the coordinates of the data."""
        to_data = torch.linalg.inv(torch.tensor(np.loadtxt(self.path.with_name(MOTION))))
        to_data[:3, 3] -= torch.tensor(world_origin(self.sequence)).to(to_data)
        scale = float(np.loadtxt(self.path.with_name(SCALE)))
        gaussians = read_gaussians(self.path, dtype=torch.float64)
        return transform(gaussians.scale_by(1 / scale), to_data)

    def _cameras(self) -> tuple[Path, NamedPoses] | None:
        """Read the cameras beside the file, if there are any: where, and names and poses."""
        file = self.path.with_name(self.path.stem + CAMERAS_SUFFIX)
        if file.is_file():
            return file, transforms.read_poses(file)
        model = self.path.with_name(self.path.stem) / MODEL
        return (model, colmap.read_poses(model)) if model.is_dir() else None

    def _matched(
        self, where: Path, poses: NamedPoses
    ) -> tuple[Float[Tensor, "V 4 4"], Float[Tensor, "V 4 4"]]:
        """Match poses to the data's by the names of their images, without folder and suffix."""
        images = self.sequence.scene.images if isinstance(self.sequence, FileSequence) else ()
        data_poses = [(str(image.file), image.cam_to_world) for image in images]
        unique = [_by_stem(named) for named in (poses, data_poses)]
        names = sorted(unique[0].keys() & unique[1].keys())
        stacked = (np.array([named[name] for name in names], dtype=np.float64) for named in unique)
        source, target = (torch.tensor(stack).reshape(len(names), 4, 4) for stack in stacked)
        # Also where there is no camera, and the spread of none is NaN.
        pairs = ((_points(p)[1], p[:, :3, 3].norm().item()) for p in (source, target))
        if not all(spread > MIN_EXTENT * distance for spread, distance in pairs):
            raise InputError(
                f"{where} has {len(names)} of the {len(data_poses)} images of "
                f"{self.sequence.name}, by their file names, in one place or none: give cameras of "
                "two or more, in different places, so that rotation, translation and scale can be "
                "fitted."
            )
        return source, target


def find_files(scenes: Path, sequences: Sequence[ImageSequence]) -> dict[str, SceneFile]:
    """Find the file of every scene of the data, by the scene's name.

    `scenes` is a folder with a file for each, named as the scene, or with the folders that Long-LRM
    writes, named so; or the file of the only scene.
    """
    option, data = f"gaussians={scenes}", {sequence.name: sequence for sequence in sequences}
    kinds, listed = ", ".join(READERS), list_names(data)
    if scenes.is_file():
        if len(data) != 1:
            raise InputError(
                f"{option} is one scene, and the data has {len(data)} to test: name the folder of "
                "that scene as data.root, or a folder with a file for each scene."
            )
        return {name: SceneFile(scenes, sequence) for name, sequence in data.items()}
    if not scenes.is_dir():
        raise InputError(f"{option} is not a file and no folder: name an existing one.")
    files = {path: path.stem for path in scenes.iterdir() if path.suffix.lower() in READERS}
    files = files or {path: path.parent.name for path in scenes.glob(f"*/{LONG_LRM}")}
    if not files:
        raise InputError(f"{option} has no scene ({kinds}): write one for each of {listed}.")
    paths: dict[str, Path] = {}
    for path, name in sorted(files.items()):
        if name in paths:
            raise InputError(
                f"{option} has two files of one scene, {paths[name].name} and {path.name}: "
                "remove one."
            )
        if name not in data:
            raise InputError(
                f"{path} is named as no scene of the data: rename or remove it; the scenes are "
                f"{listed}."
            )
        paths[name] = path
    if missing := sorted(data.keys() - paths.keys()):
        raise InputError(
            f"{option} has no file of {len(missing)} of the {len(data)} scenes, "
            f"{', '.join(missing)}: add them ({kinds}), or leave these scenes out of the data."
        )
    return {name: SceneFile(paths[name], sequence) for name, sequence in data.items()}


def check_visible(gaussians: Gaussians, cameras: Cameras, file: SceneFile, fitted: bool) -> None:
    """Check that at least half of the views show Gaussians, `fitted` by their cameras or not."""
    with torch.no_grad():
        views = cameras.resized(COVERAGE_SIZE, COVERAGE_SIZE)
        alpha = render(gaussians, views, depth=False).alpha
    empty = ((alpha > VISIBLE).float().mean((-1, -2)) < MIN_COVERAGE).sum().item()
    if 2 * empty > cameras.num_views:
        name = file.path.stem
        advice = (
            "give the cameras of this very file"
            if fitted
            else f"put its cameras beside it, {name}{CAMERAS_SUFFIX} or {name}/{MODEL}"
        )
        raise InputError(
            f"{file.path}: {empty} of {cameras.num_views} test views of {file.sequence.name} show "
            "none of its Gaussians, which looks as if they were in other coordinates than the "
            f"data: {advice}."
        )


def world_origin(sequence: ImageSequence) -> tuple[float, float, float]:
    """Return the origin of the data's world, in the coordinates of its files."""
    return sequence.scene.origin if isinstance(sequence, FileSequence) else (0.0, 0.0, 0.0)


def _by_stem(named: NamedPoses) -> dict[str, Float[ndarray, "4 4"]]:
    """Return the poses by their files' stems, where these occur once."""
    by_stem = [(PurePosixPath(name).stem, pose) for name, pose in named]
    counts = Counter(stem for stem, _ in by_stem)
    return {stem: pose for stem, pose in by_stem if counts[stem] == 1}


def _points(poses: Float[Tensor, "V 4 4"]) -> tuple[Float[Tensor, "P 3"], float]:
    """Return each camera's center and a point on each of its axes, and the spread of the centers.

    The points are as far away as the spread: so two cameras, or a line of them, fix a similarity.
    """
    centers = poses[:, :3, 3]
    spread = (centers - centers.mean(0)).square().sum(-1).mean().sqrt().item()
    tips = centers[:, None] + spread * poses[:, :3, :3].mT
    return torch.cat((centers, tips.flatten(0, 1))), spread
