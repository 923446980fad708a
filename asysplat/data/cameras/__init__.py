"""The cameras of photographs: given, refined, or found by structure from motion."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from asysplat.data.bad_images import Policy
from asysplat.data.cameras.find import find_cameras
from asysplat.data.cameras.refine import refine_cameras
from asysplat.data.images import PANORAMA
from asysplat.data.readers import without_cameras
from asysplat.data.sequence import PosedScene
from asysplat.errors import InputError

CHOICES = ("auto", "given", "checked", "refined", "found")
LEAST_GAIN = 0.01  # fraction of the reprojection error; refined cameras that gain less are not used
# Features for each match, from which on given cameras are near the truth: 0.35 to 0.6 of good ones,
# below 0.2 if axes, order, focal length or direction of the matrices are wrong.
LEAST_FEATURES = 0.25


@dataclass(frozen=True)
class CameraOptions:
    """Which cameras of photographs are used."""

    # "given" with the photographs; "refined" from those; "found" by structure from motion, as
    # always where none are given; "auto": refined if that lowers the error by LEAST_GAIN;
    # "checked": as given if points that some photographs share agree, else as "auto".
    choice: str = "given"
    where: Path = Path("logs/cameras")  # folder of found and refined cameras
    frames: int = 100  # greatest number, of a video
    console: Console | None = None

    def __post_init__(self):
        if self.choice not in CHOICES:
            raise InputError(f"cameras={self.choice}: choose {', '.join(CHOICES)}.")


def find_missing(
    path: Path | str, layout: str, on_error: Policy, options: CameraOptions
) -> Path | None:
    """Return the folder of cameras that are found; None if cameras are given."""
    bare = layout == "auto" and without_cameras(path) is not None
    if not bare and options.choice != "found":
        return None
    return find_cameras(path, options.where, options.frames, on_error, options.console)


def refine_given(
    scene: PosedScene, options: CameraOptions, say: Callable[[str], None]
) -> tuple[PosedScene, bool]:
    """Return a scene with refined cameras where wanted, and whether the given ones are right."""
    if options.choice in ("given", "found"):
        return scene, False
    images = [image for image in scene.images if image.lens.model != PANORAMA]
    files = {image.file for image in images if isinstance(image.file, Path)}
    if len(files) < len(scene.images):
        say("cameras: as given; panoramas and images inside other files are not refined.")
        return scene, False
    result = refine_cameras(scene, options.where, options.console)
    if not result.features:
        say("cameras: as given; too few features match to refine them.")
        return scene, False
    refined = options.choice == "refined" or result.after < (1 - LEAST_GAIN) * result.before
    say(
        f"cameras: {'refined' if refined else 'as given'} (cameras=); {result.features:,} features "
        f"are {result.before:.2f} px from their points with the given cameras, and "
        f"{result.after:.2f} px with refined ones"
    )
    agree = result.features > LEAST_FEATURES * result.matched
    return result.scene if refined else scene, agree
