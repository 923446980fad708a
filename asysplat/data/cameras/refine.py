"""Refine the cameras of posed photographs: bundle adjustment of features that match.

Triggs et al. 2000, Bundle Adjustment: A Modern Synthesis; with COLMAP, by pycolmap.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray
from rich.console import Console
from rich.progress import Progress

from asysplat.data.bad_images import BadImages
from asysplat.data.cameras.features import SEED, USUAL, match_photographs
from asysplat.data.cameras.folder import (
    ERRORS,
    colmap_names,
    digest,
    keep,
    link_photograph,
    save_mask,
    work_folder,
)
from asysplat.data.readers import colmap
from asysplat.data.readers.common import invert_pose
from asysplat.data.sequence import Points, PosedImage, PosedScene

ROUNDS = 2  # rounds of triangulation and bundle adjustment
LEAST_POINTS = 20  # points that a photograph must see for its pose to be refined
LEAST_OF_LENS = 10  # photographs of a lens, for its focal length and distortion to be refined


@dataclass(frozen=True)
class RefinedCameras:
    """Refined cameras, and how well they and the original ones fit the same points."""

    scene: PosedScene  # with the refined cameras
    before: float  # mean distance of the points' projections from their features, in pixels
    after: float
    features: int  # number of these features; with none the cameras are as they were
    matched: int  # number of matches between photographs, which no camera has a part in


def refine_cameras(
    scene: PosedScene, where: Path | str, console: Console | None = None
) -> RefinedCameras:
    """Refine poses of a scene's photographs, and focal lengths and distortions of their lenses.

    A lens of fewer than 10 photographs stays as it is. The result is moved back by a similarity to
    the given world and scale; photographs that see few of the points keep their poses. It is
    written to a folder in COLMAP's layout, where the next call with the same input reads it.
    """
    where = Path(where).absolute()
    images = {image.file: image for image in scene.images if isinstance(image.file, Path)}
    assert len(images) == len(scene.images)  # files, each once
    names = colmap_names(images)
    cameras = [(image.lens, image.cam_to_world.tolist()) for image in scene.images]
    masks = [m for file, image in images.items() if isinstance(m := image.mask, Path) and m != file]
    method = f"matched {USUAL} {LEAST_OF_LENS} {cameras}"
    folder = where / f"{scene.name}-refined-{digest(method, [*images, *masks])}"
    if not folder.is_dir():
        with work_folder(where, len(images), console) as (work, progress):
            for file, name in names.items():
                link_photograph(file, work / "images" / name)
                save_mask(images[file].mask, work / "images" / name)
            named = {names[file]: image for file, image in images.items()}
            keep(work, _refine(work, named, progress), folder)
    errors = json.loads((folder / ERRORS).read_text())
    if not errors["features"]:
        return RefinedCameras(scene, **errors)
    refined_scene = colmap.read_scene(folder, BadImages())
    refined = {image.file.name: image for image in refined_scene.images}
    pairs = [(image, refined[names[file]]) for file, image in images.items()]
    changed = [replace(old, lens=new.lens, cam_to_world=new.cam_to_world) for old, new in pairs]

    def read_points() -> Points | None:
        points = refined_scene.points
        return None if points is None else points + scene.origin

    return RefinedCameras(replace(scene, images=changed, read_points=read_points), **errors)


def _refine(
    work: Path, images: Mapping[str, PosedImage], progress: Progress
) -> pycolmap.Reconstruction:
    """Return a model with refined cameras of work/images/NAME; write its errors to `work`."""
    lenses = {name: image.lens for name, image in images.items()}
    # The distortion of a pinhole is refined as well.
    models = {lens: "OPENCV" if "PINHOLE" in lens.model else lens.model for lens in lenses.values()}
    cameras = {lens: replace(lens, model=model).camera() for lens, model in models.items()}
    database = match_photographs(work, lenses, USUAL, progress, cameras)
    poses = {name: image.cam_to_world for name, image in images.items()}
    model = _posed_model(database, poses)
    task = progress.add_task("refinement", total=2 * ROUNDS)
    # With more threads, sums vary in their last bits.
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, num_threads=1)
    errors = {"before": 0.0, "after": 0.0, "features": 0}
    with pycolmap.Database.open(database) as stored:
        matched = stored.num_inlier_matches()
    for number in range(ROUNDS):
        model = pycolmap.triangulate_points(model, database, work / "images", work, True, options)
        progress.advance(task)
        if not model.num_points3D():
            break
        before = model.compute_mean_reprojection_error()
        _adjust(model)
        model.update_point_3d_errors()
        progress.advance(task)
        if number == 0:
            errors = {"before": before, "after": model.compute_mean_reprojection_error()}
            errors["features"] = model.compute_num_observations()
    _move_back(model, poses)
    (work / ERRORS).write_text(json.dumps(errors | {"matched": matched}))
    return model


def _posed_model(
    database: Path, poses: Mapping[str, Float[ndarray, "4 4"]]
) -> pycolmap.Reconstruction:
    """Return a model without points of the images in a database, with given poses."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as stored:
        for camera in stored.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in stored.read_all_images():
            names = {"name": image.name, "camera_id": image.camera_id, "image_id": image.image_id}
            pose = pycolmap.Rigid3d(invert_pose(poses[image.name])[:3])
            model.add_image_with_trivial_frame(pycolmap.Image(**names), pose)
    return model


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Adjust poses and points of a model to its features, and lenses of several photographs."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_principal_point = False
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    photographs = Counter(image.camera_id for image in model.images.values())
    for camera, count in photographs.items():
        if count < LEAST_OF_LENS:
            config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _move_back(model: pycolmap.Reconstruction, poses: Mapping[str, Float[ndarray, "4 4"]]) -> None:
    """Move a model by the similarity that brings its cameras to `poses`."""
    images = {image.name: image for image in model.images.values()}
    old_poses = np.stack([poses[name] for name in images])
    new_poses = np.stack([image.cam_from_world().inverse().matrix() for image in images.values()])
    # From the rotations: positions alone, if in a line, leave a turn about it free.
    products = old_poses[:, :3, :3] @ new_poses[:, :3, :3].swapaxes(1, 2)
    left, _, right = np.linalg.svd(products.sum(0))
    rotation = left @ right
    means = [poses[:, :3, 3].mean(0) for poses in (old_poses, new_poses)]
    centers = old_poses[:, :3, 3] - means[0]
    turned = (new_poses[:, :3, 3] - means[1]) @ rotation.T
    square = np.square(turned).sum()
    scale = (centers * turned).sum() / square if square else 1.0
    translation = means[0] - scale * rotation @ means[1]
    model.transform(pycolmap.Sim3d(np.column_stack([scale * rotation, translation])))
    for name, image in images.items():
        if image.num_points3D < LEAST_POINTS:
            image.frame.rig_from_world = pycolmap.Rigid3d(invert_pose(poses[name])[:3])
