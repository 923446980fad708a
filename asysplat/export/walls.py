"""How far a camera path may go before it meets a wall."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

HEIGHT, WIDTH = 4, 16  # pixels of a look outward, which is flat, as the ground is no wall
FOCAL = 16.0  # pixels: 27 degrees to either side, 7 up and down
CLEARANCE = 0.5  # fraction of the way to a wall that may be gone
WINDOW = 0.05  # fraction of the frames, before and after a wall, in which a path evades it


def free_radii(
    gaussians: Gaussians,
    outward: Float[ndarray, "T 4 4"],
    starts: Float[ndarray, " T"],
    radius: float,
) -> Float[ndarray, " T"]:
    """Compute the radii of a closed path that smoothly evades walls, `radius` where it meets none.

    A wall is the first that a look outward meets with half of the opacity, in any pixel.

    Args:
        gaussians: scene.
        outward: cam_to_world of each frame's look, from a point in free space.
        starts: radii of these points, `radius` at most.
        radius: radius of the path without walls.
    """
    # Here, as it would slow down import asysplat.
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    poses = torch.from_numpy(outward).to(gaussians.means)
    lens = poses.new_tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    looks = Cameras(lens.expand(len(poses), 3, 3), poses, HEIGHT, WIDTH)
    with torch.no_grad():
        depths = render(gaussians, looks, depth="median", views_at_once=1).depth
    ways = torch.where(depths > 0, depths, torch.inf).amin((-2, -1)).cpu().double().numpy()
    radii = np.minimum(radius, starts + CLEARANCE * ways)
    if (radii == radius).all():
        return radii
    half = max(1, round(WINDOW * len(radii)))
    radii = minimum_filter1d(radii, 2 * half + 1, mode="wrap")
    for _ in range(2):  # both together within the minimum's window: no radius exceeds its bound
        radii = uniform_filter1d(radii, half + 1 - half % 2, mode="wrap")
    return radii
