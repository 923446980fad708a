"""Synthetic rooms and outdoor places, rendered from a seed: images with exact depths."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.data.procedural.clutter import add_clutter, polish
from asysplat.data.procedural.floor_plan import furnished_room, outdoor_place
from asysplat.data.procedural.path import above, arc, circle, forward, hand_held_path, pan
from asysplat.data.procedural.world import World
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views

SPLITS = ("train", "val", "test")
PLACES = ("both", "rooms", "outdoors")
VARIED_PATHS = (arc, arc, circle, above, above, forward, pan)
FOV, VARIED_FOV = (60, 75), (25, 80)  # range in degrees along the longer side
CPU_CHUNK = 4096  # rays traced at once on a CPU, so that they stay in its cache
PROBE_IMAGES = 4  # images that set the exposure
PROBE_SIZE = 16  # pixels a side of those images
MIN_LIGHT = 1e-3  # darker is black
CONTRAST = 1.1  # standard deviation of the log light along a path, before the S-curve
BRIGHTNESS = -0.2  # mean of the same
# A rotated grid: an edge at any angle crosses the four rays one after the other.
SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
# Offsets (x, y) from a pixel to itself and its neighbors.
NEIGHBORS = ((0, 0), (0, -1), (-1, 0), (1, 0), (0, 1))


def split_seed(split: Literal["train", "val", "test"], index: int) -> int:
    """Return the seed of a scene: every third number, so that splits are disjoint."""
    if split not in SPLITS:
        raise InputError(f"split is {split!r}: expected one of {', '.join(SPLITS)}.")
    if index < 0:
        raise InputError(f"index is {index}: scenes are numbered from 0.")
    return 3 * index + SPLITS.index(split)


class ProceduralScene:
    """An `ImageSequence` of a synthetic place: textured boxes, spheres, and walls or hills.

    Training uses varied scenes; validation and test use plain scenes, so that their metrics stay
    comparable. One unit is a meter, z is up. The same seed gives the same place and path on every
    device, and the same bits on a CPU.

    Args:
        places: rooms or outdoors; with both, the seed decides.
        varied: adds thin and small near objects, gloss, antialiased edges, more kinds of camera
            paths, and focal lengths from wide to long.
    """

    points = None  # no sparse points: depths show the surfaces

    def __init__(
        self,
        seed: int,
        height: int,
        width: int,
        num_images: int = 96,
        device: str | torch.device = "cpu",
        places: str = "both",
        varied: bool = False,
    ):
        if places not in PLACES:
            raise InputError(f"data.places is {places!r}: expected one of {', '.join(PLACES)}.")
        rng = np.random.default_rng(seed)
        self.name = f"{'procedural' if places == 'both' else places}-{seed}"
        self.num_images = num_images
        # Drawn even if `places` decides, to keep all later draws the same.
        heads = rng.random() < 0.5
        indoors = heads if places == "both" else places == "rooms"
        half = rng.uniform((2.8, 2.8, 1.3), (4.0, 4.0, 1.6))
        radius = 0.58 * half[:2].min() if indoors else rng.uniform(2.4, 3.2)
        path = VARIED_PATHS[rng.integers(len(VARIED_PATHS))] if varied else arc
        poses = hand_held_path(rng, num_images, radius, path)
        walk = poses[:, :2, 3]
        plan = furnished_room(rng, walk, half) if indoors else outdoor_place(rng, walk)
        if varied:
            add_clutter(plan, rng)
            polish(plan, rng)
        fov = rng.uniform(*(VARIED_FOV if varied else FOV))
        # Centered, with square pixels, and `fov` along the longer side.
        focal = max(height, width) / 2 / np.tan(np.radians(fov) / 2)
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        intrinsics, cam_to_world = (
            torch.as_tensor(values, dtype=torch.float32) for values in (matrix, poses)
        )
        intrinsics = intrinsics.repeat(num_images, 1, 1)
        self.cameras = Cameras(intrinsics, cam_to_world, height, width).to(device)
        self._antialiased = varied
        self._world = World(plan, rng, self.cameras.intrinsics.device)
        self._expose()

    def views(self, indices: Sequence[int]) -> Views:
        """Render the images at `indices`, with the exact depth at every pixel center."""
        cameras = self.cameras.select(list(indices))
        light, depths = self._trace(cameras)
        # An S-curve of the logarithm, as film has.
        light = light.clamp(min=MIN_LIGHT).log()
        return Views(cameras, torch.sigmoid(light * self._gamma - self._threshold), depths)

    def _trace(self, cameras: Cameras) -> tuple[Float[Tensor, "V 3 H W"], Float[Tensor, "V H W"]]:
        size = (cameras.height, cameras.width)
        # All images share their intrinsics; with directions of z = 1, t is the depth.
        in_camera = cameras.select([0]).pixel_directions().flatten(0, 2).T.contiguous()
        light = in_camera.new_empty(cameras.num_views, 3, size[0] * size[1])
        depths = in_camera.new_empty(cameras.num_views, size[0] * size[1])
        surfaces = torch.empty(size[0] * size[1], dtype=torch.long, device=in_camera.device)
        chunk = CPU_CHUNK if in_camera.device.type == "cpu" else in_camera.shape[1]
        pixel = 1 / cameras.intrinsics[0, 0, 0].item()
        for view, pose in enumerate(cameras.cam_to_world):
            directions = pose[:3, :3] @ in_camera
            for start in range(0, directions.shape[1], chunk):
                part = slice(start, start + chunk)
                light[view, :, part], depths[view, part], surfaces[part] = self._world.trace(
                    pose[:3, 3:], directions[:, part], pixel
                )
            if self._antialiased:
                edges = edge_pixels(surfaces.view(size))
                sharp = light[view].clone()
                for part in edges.split(max(1, chunk // len(SAMPLES))) if len(edges) else ():
                    around = pose[:3, :3] @ sample_directions(in_camera[:, part], pixel)
                    hit = self._world.surfaces(pose[:3, 3:], around, candidates=surfaces)
                    light[view, :, part] = average_samples(sharp, surfaces.view(size), part, hit)
        return light.unflatten(-1, size), depths.unflatten(-1, size)

    def _expose(self) -> None:
        """Set one exposure and contrast for the whole path."""
        indices = np.linspace(0, self.num_images - 1, PROBE_IMAGES).round().astype(int)
        probe = self.cameras.select(indices.tolist()).resized(PROBE_SIZE, PROBE_SIZE)
        in_camera = probe.select([0]).pixel_directions().flatten(0, 2).T.contiguous()
        # All images at once, as so few rays take longer to start than to trace.
        origins = probe.centers.T.repeat_interleave(PROBE_SIZE**2, 1)
        directions = torch.cat([pose[:3, :3] @ in_camera for pose in probe.cam_to_world], 1)
        pixel = 1 / probe.intrinsics[0, 0, 0].item()
        light, _, _ = self._world.trace(origins, directions, pixel)
        levels = light.unflatten(1, (PROBE_IMAGES, -1)).transpose(0, 1).contiguous()
        levels = levels.clamp(min=MIN_LIGHT).log()
        self._gamma = CONTRAST / levels.std()
        self._threshold = self._gamma * levels.mean() - BRIGHTNESS


# Antialiased edges, by several rays a pixel where two surfaces meet. These rays only find which
# surface they hit; its color is taken from the nearest pixel showing it.


def edge_pixels(surfaces: Int[Tensor, "H W"]) -> Int[Tensor, " E"]:
    """Return the flat indices of pixels beside, above or below a pixel of another surface."""
    edges = torch.zeros_like(surfaces, dtype=torch.bool)
    beside, above = surfaces[:, 1:] != surfaces[:, :-1], surfaces[1:] != surfaces[:-1]
    edges[:, 1:] |= beside
    edges[:, :-1] |= beside
    edges[1:] |= above
    edges[:-1] |= above
    return edges.flatten().nonzero()[:, 0]


def sample_directions(directions: Float[Tensor, "3 E"], pixel: float) -> Float[Tensor, "3 SE"]:
    """Return SAMPLES directions around each pixel center's, z = 1; `pixel` is its width there."""
    offsets = pixel * torch.tensor(SAMPLES, device=directions.device).T[..., None]
    x, y, z = directions[:, None].expand(-1, len(SAMPLES), -1)
    return torch.stack((x + offsets[0], y + offsets[1], z)).flatten(1)


def average_samples(
    colors: Float[Tensor, "3 HW"],
    surfaces: Int[Tensor, "H W"],
    pixels: Int[Tensor, " E"],
    sampled: Int[Tensor, " SE"],
) -> Float[Tensor, "3 E"]:
    """Average the colors of the surfaces `sampled` by the rays of `sample_directions`.

    A surface that no neighboring pixel shows is replaced by the pixel's own.
    """
    height, width = surfaces.shape
    x, y = torch.tensor(NEIGHBORS, device=pixels.device).T[..., None]
    around = ((pixels // width + y).clamp(0, height - 1)) * width
    around += (pixels % width + x).clamp(0, width - 1)
    shown = surfaces.flatten()[around]
    sampled = sampled.view(len(SAMPLES), -1)
    # The first neighbor that shows the surface has the largest countdown.
    countdown = torch.arange(len(NEIGHBORS), 0, -1, device=pixels.device)[:, None, None]
    latest = torch.where(shown[:, None] == sampled, countdown, 0).amax(0)
    first = (len(NEIGHBORS) - latest) % len(NEIGHBORS)
    return colors[:, around.gather(0, first)].mean(1)
