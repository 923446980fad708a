"""Reader of ScanNet++ where depths are measured: the images that have depth maps.

A scene's folder stands for the first of these files that has images and depths; the undistorted
images of the reflex camera have none. All else is as in `scannetpp`.

<scene>/dslr/nerfstudio/transforms.json      with the toolkit's render_depth
<scene>/iphone/nerfstudio/transforms.json    with depth, as the next
<scene>/iphone/pose_intrinsic_imu.json
"""

from pathlib import Path

from asysplat.data.bad_images import BadImages
from asysplat.data.readers import common, scannetpp
from asysplat.data.sequence import PosedScene
from asysplat.errors import InputError


def find_scenes(root: Path) -> list[Path]:
    """Find the file of poses of each scene's folder, or the named one."""
    scenes = [root] if root.is_file() else common.folders_with(root, *scannetpp.PARTS)
    return [file for scene in scenes for file in _with_depths(scene)]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a scene as `scannetpp.read_scene`; a folder stands for its images with depths."""
    files = find_scenes(scene)
    return scannetpp.read_scene(files[0] if len(files) == 1 else scene, bad)


def _with_depths(scene: Path) -> list[Path]:
    if scene.is_file():
        return scannetpp.find_scenes(scene)
    for key, (images, _, depths, _) in scannetpp.PARTS.items():
        camera = scene / key.split("/")[0]
        has_folders = [(camera / folder).is_dir() for folder in (images, depths) if folder]
        if (scene / key).is_file() and has_folders == [True, True]:
            return [scene / key]
    raise InputError(
        f"{scene} has no depth maps, which are measured here: render the reflex camera's with the "
        "toolkit (dslr/render_depth), or extract the iPhone's (iphone/depth)."
    )
