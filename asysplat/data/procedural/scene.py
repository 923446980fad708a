"""A room or a place outdoors, made from a seed: photographs with exact depths, without a file."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data.procedural.clutter import add_clutter, polish
from asysplat.data.procedural.edges import SAMPLES, edge_pixels, mixed, samples
from asysplat.data.procedural.floor_plan import furnished_room, outdoor_place
from asysplat.data.procedural.path import above, arc, circle, forward, hand_held_path, pan
from asysplat.data.procedural.world import World
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views

SPLITS = ("train", "val", "test")
PLACES = ("both", "rooms", "outdoors")
VARIED_PATHS = (arc, arc, circle, above, above, forward, pan)
FOV, VARIED_FOV = (60, 75), (25, 80)  # least and greatest, degrees along the longer side
RAYS_IN_CACHE = 4096  # traced at once on a CPU
PROBE_FRAMES = 4  # frames by which the exposure is set
PROBE_SIZE = 16  # pixels a side of those frames
DARKEST = 1e-3  # light below this is black
CONTRAST = 1.1  # standard deviation of a walk's log light before the film's S-curve
BRIGHTNESS = -0.2  # mean of the same


def split_seed(split: Literal["train", "val", "test"], index: int) -> int:
    """Return the seed of scene `index` of a split; no seed is in two splits.

    Each split takes every third number.

    Raises:
        InputError: unknown split or negative index.
    """
    if split not in SPLITS:
        raise InputError(f"split is {split!r}: expected one of {', '.join(SPLITS)}.")
    if index < 0:
        raise InputError(f"index is {index}: scenes are numbered from 0.")
    return 3 * index + SPLITS.index(split)


class ProceduralScene:
    """An `ImageSequence` of a synthetic place: textured boxes, spheres, walls or hills along a walk.

    Training draws varied ones; validation and test are on plain ones, so that their numbers stay
    comparable. One unit is a meter, z is up. The same seed gives the same place and walk on every
    device, and the same bits on a CPU.

    Args:
        seed: any integer >= 0; see `split_seed`.
        height, width: of the images, pixels.
        num_frames: how finely the walk is sampled.
        device: where images are computed.
        places: rooms or outdoors; with both, the seed decides.
        varied: whether there are thin and small near things, gloss, smooth edges, cameras that
            circle, look down from above, walk forward or pan, and focal lengths from wide to long.

    Raises:
        InputError: unknown places.
    """

    def __init__(
        self,
        seed: int,
        height: int,
        width: int,
        num_frames: int = 96,
        device: str | torch.device = "cpu",
        places: str = "both",
        varied: bool = False,
    ):
        if places not in PLACES:
            raise InputError(f"data.places is {places!r}: expected one of {', '.join(PLACES)}.")
        rng = np.random.default_rng(seed)
        self.name = f"{'procedural' if places == 'both' else places}-{seed}"
        self.num_frames = num_frames
        # Drawn even if `places` decides, so that all later draws stay the same.
        heads = rng.random() < 0.5
        indoors = heads if places == "both" else places == "rooms"
        half = rng.uniform((2.8, 2.8, 1.3), (4.0, 4.0, 1.6))
        radius = 0.58 * half[:2].min() if indoors else rng.uniform(2.4, 3.2)
        path = VARIED_PATHS[rng.integers(len(VARIED_PATHS))] if varied else arc
        poses = hand_held_path(rng, num_frames, radius, path)
        walk = poses[:, :2, 3]
        plan = furnished_room(rng, walk, half) if indoors else outdoor_place(rng, walk)
        if varied:
            add_clutter(plan, rng)
            polish(plan, rng)
        fov = rng.uniform(*(VARIED_FOV if varied else FOV))
        self.cameras = _cameras(poses, fov, height, width).to(device)
        self._smooth_edges = varied
        self._world = World(plan, rng, self.cameras.intrinsics.device)
        self._expose()

    def views(self, frames: Sequence[int]) -> Views:
        """Return the named frames, with the exact depth of every pixel center's ray."""
        cameras = self.cameras.select(list(frames))
        light, depths = self._shoot(cameras)
        return Views(cameras, self._develop(light), depths)

    def _shoot(self, cameras: Cameras) -> tuple[Float[Tensor, "V 3 H W"], Float[Tensor, "V H W"]]:
        """Trace the light and the depth at every pixel."""
        size = (cameras.height, cameras.width)
        # All frames share their intrinsics; with directions of z = 1, t is the depth.
        in_camera = cameras.select([0]).pixel_directions().flatten(0, 2).T.contiguous()
        light = in_camera.new_empty(cameras.num_views, 3, size[0] * size[1])
        depths = in_camera.new_empty(cameras.num_views, size[0] * size[1])
        surfaces = torch.empty(size[0] * size[1], dtype=torch.long, device=in_camera.device)
        at_once = RAYS_IN_CACHE if in_camera.device.type == "cpu" else in_camera.shape[1]
        pixel = 1 / cameras.intrinsics[0, 0, 0].item()
        for view, pose in enumerate(cameras.cam_to_world):
            directions = pose[:3, :3] @ in_camera
            for start in range(0, directions.shape[1], at_once):
                part = slice(start, start + at_once)
                light[view, :, part], depths[view, part], surfaces[part] = self._world.trace(
                    pose[:3, 3:], directions[:, part], pixel
                )
            if self._smooth_edges:
                edges = edge_pixels(surfaces.view(size))
                sharp = light[view].clone()
                for part in edges.split(max(1, at_once // len(SAMPLES))) if len(edges) else ():
                    around = pose[:3, :3] @ samples(in_camera[:, part], pixel)
                    seen = self._world.surfaces(pose[:3, 3:], around, among=surfaces)
                    light[view, :, part] = mixed(sharp, surfaces.view(size), part, seen)
        return light.unflatten(-1, size), depths.unflatten(-1, size)

    def _develop(self, light: Float[Tensor, "V 3 H W"]) -> Float[Tensor, "V 3 H W"]:
        """Map light into [0, 1] as film does: by an S-curve of its logarithm."""
        return torch.sigmoid(light.clamp(min=DARKEST).log() * self._gamma - self._threshold)

    def _expose(self) -> None:
        """Set exposure and contrast once for the whole walk, as a photographer would."""
        frames = np.linspace(0, self.num_frames - 1, PROBE_FRAMES).round().astype(int)
        probe = self.cameras.select(frames.tolist()).resized(PROBE_SIZE, PROBE_SIZE)
        in_camera = probe.select([0]).pixel_directions().flatten(0, 2).T.contiguous()
        # All frames at once, as so few rays take longer to start than to trace.
        origins = probe.centers.T.repeat_interleave(PROBE_SIZE**2, 1)
        directions = torch.cat([pose[:3, :3] @ in_camera for pose in probe.cam_to_world], 1)
        pixel = 1 / probe.intrinsics[0, 0, 0].item()
        light, _, _ = self._world.trace(origins, directions, pixel)
        levels = light.unflatten(1, (PROBE_FRAMES, -1)).transpose(0, 1).contiguous()
        levels = levels.clamp(min=DARKEST).log()
        self._gamma = CONTRAST / levels.std()
        self._threshold = self._gamma * levels.mean() - BRIGHTNESS


def _cameras(poses: np.ndarray, fov: float, height: int, width: int) -> Cameras:
    """Make cameras with square pixels, centerd, with `fov` degrees along the longer side."""
    focal = max(height, width) / 2 / np.tan(np.radians(fov) / 2)
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    intrinsics = torch.as_tensor(matrix, dtype=torch.float32)
    cam_to_world = torch.as_tensor(poses, dtype=torch.float32)
    return Cameras(intrinsics.repeat(len(poses), 1, 1), cam_to_world, height, width)
