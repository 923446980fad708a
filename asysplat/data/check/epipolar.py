"""Two views of one point: how far it is from its epipolar lines, and how deep it lies."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data.check.matching import Matches
from asysplat.scene import Cameras


def epipolar_lines(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """Of each match, in either view, the line on which its point in the other view puts it.

    Returns:
        a, b, c, of which a x + b y + c is a distance in pixels; NaN where both views were taken
        from one place.
    """
    rotations = cameras.cam_to_world[..., :3, :3]
    centers = cameras.centers[matches.frames]
    baseline = centers[:, 1] - centers[:, 0]
    # The plane through a ray of one view and the centre of the other is seen as a line there.
    normals = torch.linalg.cross(baseline[:, None].expand(-1, 2, -1), _rays(cameras, matches))
    to_pixels = torch.linalg.inv(cameras.intrinsics).mT @ rotations.mT
    lines = (to_pixels[matches.frames] @ normals.flip(1)[..., None])[..., 0]
    return lines / lines[..., :2].norm(dim=-1, keepdim=True)


def epipolar_distances(cameras: Cameras, matches: Matches) -> Float[Tensor, " M"]:
    """Distances in pixels to the epipolar lines, the mean of both views; infinite where both were
    taken from one place."""
    lines = epipolar_lines(cameras, matches)
    residuals = (lines[..., :2] * matches.points).sum(-1) + lines[..., 2]
    return residuals.abs().mean(-1).nan_to_num(nan=torch.inf)


def triangulate(
    cameras: Cameras, matches: Matches
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, " M"]]:
    """Where the two rays of a match pass nearest to each other.

    Returns:
        Depths along the z axes of both cameras, in scene units, and the angle between the rays, in
        degrees.
    """
    rays = _rays(cameras, matches)
    centers = cameras.centers[matches.frames]
    baseline = centers[:, 1] - centers[:, 0]
    # Normal equations of |x first - y second - baseline|.
    first, second = rays.unbind(1)
    aa, bb, ab = (first**2).sum(-1), (second**2).sum(-1), (first * second).sum(-1)
    ac, bc = (first * baseline).sum(-1), (second * baseline).sum(-1)
    cross = torch.linalg.cross(first, second).norm(dim=-1)
    depths = torch.stack((bb * ac - ab * bc, ab * ac - aa * bc), -1) / cross[:, None] ** 2
    return depths, torch.rad2deg(torch.atan2(cross, ab))


def _rays(cameras: Cameras, matches: Matches) -> Float[Tensor, "M 2 3"]:
    """World-space directions through the points, of depth 1."""
    points = torch.nn.functional.pad(matches.points, (0, 1), value=1.0)
    to_world = cameras.cam_to_world[..., :3, :3] @ torch.linalg.inv(cameras.intrinsics)
    return (to_world[matches.frames] @ points[..., None])[..., 0]
