"""Depth maps fused in a truncated signed distance function, and its surface as a colored mesh.

Method: Curless & Levoy 1996, on blocks of voxels around the surfaces (Nießner et al. 2013).
"""

from dataclasses import replace
from itertools import repeat
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.scene import Cameras

TRUNCATION = 4  # voxels
SIDE = 2 * TRUNCATION  # voxels along a block
FAR = 4.0  # median depths, beyond which no surface is meshed
MAX_BLOCKS = 2**15  # above which voxels become larger
CHUNK = 256  # blocks at once, so that they stay in a CPU's cache
LEAST = 1e-3  # distance in truncations: no vertex lies in a corner of a cube, but on its edges
UNSEEN = 1e-6  # weight of a color before or behind a vertex
BITS = 21  # of a coordinate in a cell's number


class Mesh(NamedTuple):
    """Triangles with a color at every vertex.

    Args:
        vertices: [P, 3] in scene units.
        faces: [F, 3] numbers of vertices, counterclockwise as seen from free space.
        colors: [P, 3] RGB in [0, 1].
    """

    vertices: Float[Tensor, "P 3"]
    faces: Int[Tensor, "F 3"]
    colors: Float[Tensor, "P 3"]


def fuse(
    depths: Float[Tensor, "V H W"],
    images: Float[Tensor, "V 3 H W"],
    cameras: Cameras,
    voxel: float | None = None,
) -> Mesh:
    """Fuse depth maps of one scene into a colored mesh, open where nothing was seen.

    A corner of a voxel gets the mean over the views of min(1, (depth - z) / truncation), of those
    where it is above -1: surfaces are where this is 0, and a view that sees through a floater
    removes it. Surfaces farther than FAR median depths from all cameras are left out.

    Args:
        depths: along the camera's z axis, in scene units; 0 if unknown, infinity where all is free.
        images: RGB in [0, 1].
        cameras: [V].
        voxel: side of a voxel, in scene units; None: a pixel's at the median depth. It becomes
            larger where MAX_BLOCKS would not hold all surfaces.
    """
    seen = (depths > 0) & depths.isfinite()
    if not seen.any():
        return Mesh(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.long), torch.empty(0, 3))
    far = FAR * depths[seen].median().item()
    if voxel is None:
        focal = cameras.intrinsics[:, 0, 0, None, None]
        voxel = (depths / focal)[seen].median().item()
    # Numbers near 0 are exact, and fit into a cell's number.
    origin = cameras.centers.double().mean(0)
    poses = cameras.cam_to_world.double()
    poses[:, :3, 3] -= origin
    cameras = replace(cameras, cam_to_world=poses, intrinsics=cameras.intrinsics.double())
    while len(blocks := _find_blocks(depths, cameras, voxel, far)) > MAX_BLOCKS:
        voxel *= (len(blocks) / MAX_BLOCKS) ** 0.5
    corners, faces, count = [], [], 0
    for chunk in blocks.split(CHUNK):
        chunk_corners, chunk_faces = _march(chunk, *_integrate(chunk, depths, cameras, voxel))
        corners.append(chunk_corners)
        faces.append(chunk_faces + count)
        count += len(chunk_corners)
    corners, faces = torch.cat(corners), torch.cat(faces)
    # Blocks share the vertices of their borders: one an edge, whose middle numbers it.
    middles = _number(corners.floor().long() + corners.ceil().long())
    _, first, merged = np.unique(middles, return_index=True, return_inverse=True)
    vertices, faces = voxel * corners[first], torch.from_numpy(merged)[faces]
    colors = _mean_colors(vertices, depths, images, cameras, TRUNCATION * voxel)
    return Mesh((vertices + origin).float(), faces, colors)


def _find_blocks(
    depths: Float[Tensor, "V H W"], cameras: Cameras, voxel: float, far: float
) -> Int[Tensor, "N 3"]:
    """Return the blocks that hold all that is within a truncation of a pixel's surface."""
    cells = []
    for view, depth in enumerate(depths):
        camera, shown = cameras.select([view]), (depth > 0) & (depth < far)
        local = camera.pixel_directions()[0][shown] * depth[shown, None]
        points = camera.centers + local @ camera.cam_to_world[0, :3, :3].mT
        cells.append(_number((points / (TRUNCATION * voxel)).floor().long()).unique())
    # Two cells are a block's side: those beside a cell lie in eight blocks.
    around = torch.cartesian_prod(*repeat(torch.tensor([-1, 1]), 3))
    near = (_cell(torch.cat(cells).unique())[:, None] + around).flatten(0, 1)
    return _cell(_number(near.div(2, rounding_mode="floor")).unique())


def _number(cells: Int[Tensor, "N 3"]) -> Int[Tensor, "N"]:
    x, y, z = (cells + (1 << BITS - 1)).unbind(-1)
    return x << 2 * BITS | y << BITS | z


def _cell(numbers: Int[Tensor, "N"]) -> Int[Tensor, "N 3"]:
    shifts = torch.tensor([2 * BITS, BITS, 0])
    return (numbers[:, None] >> shifts & (1 << BITS) - 1) - (1 << BITS - 1)


def _integrate(
    blocks: Int[Tensor, "N 3"], depths: Float[Tensor, "V H W"], cameras: Cameras, voxel: float
) -> tuple[Float[Tensor, "N side side side"], Bool[Tensor, "N side side side"]]:
    """Compute the distances, in truncations, at all corners of the blocks' voxels.

    Neighbors share the corners between them, and compute the same numbers there.

    Returns:
        Distances; whether a view sees the corner, or what is a truncation before it.
    """
    corners = SIDE * blocks[..., None] + torch.arange(SIDE + 1)
    total = torch.zeros(len(blocks), *repeat(SIDE + 1, 3))
    count = torch.zeros_like(total)
    width, height = cameras.width, cameras.height
    frustum = [[1, 0, 0], [-1, 0, width], [0, 1, 0], [0, -1, height], [0, 0, 1]]
    frustum = torch.tensor(frustum, dtype=torch.float64)
    poses, band = cameras.cam_to_world, TRUNCATION * voxel
    for depth, intrinsics, pose in zip(depths, cameras.intrinsics, poses, strict=True):
        # Of a corner's integers, z times x, z times y, and z are linear functions.
        matrix = intrinsics @ pose[:3, :3].mT
        offset = -matrix @ pose[:3, 3]
        matrix = voxel * matrix
        # A block is in view if its foremost point is on the inner side of all planes.
        planes = frustum @ matrix
        inside = SIDE * ((blocks.double() + 0.5) @ planes.mT + 0.51 * planes.abs().sum(1))
        near = (inside + frustum @ offset > 0).all(1).nonzero()[:, 0]
        terms = matrix[:, :, None, None] * corners[near].movedim(1, 0)
        terms[:, 2] += offset[:, None, None]
        x, y, z = (
            i[:, :, None, None] + j[:, None, :, None] + k[:, None, None, :]
            for i, j, k in terms.float()
        )
        x, y = x / z, y / z
        inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixel = torch.where(inside, y.floor() * width + x.floor(), 0).long()
        found = depth.take(pixel)
        distance = (found - z) / band
        inside &= (found > 0) & (distance > -1)
        total[near] += torch.where(inside, distance.clamp_max(1), 0)
        count[near] += inside
    mean = total / count.clamp_min(1)
    return torch.copysign(mean.abs().clamp_min(LEAST), mean), count > 0


def _march(
    blocks: Int[Tensor, "N 3"],
    distances: Float[Tensor, "N side side side"],
    seen: Bool[Tensor, "N side side side"],
) -> tuple[Float[Tensor, "P 3"], Int[Tensor, "F 3"]]:
    """Triangulate where the distance is 0, in voxels, by marching cubes whose corners are seen."""
    from skimage.measure import marching_cubes

    lowest, highest = -F.max_pool3d(-distances, 2, 1), F.max_pool3d(distances, 2, 1)
    cubes = (lowest < 0) & (highest > 0) & (F.max_pool3d((~seen).float(), 2, 1) == 0)
    if not cubes.any():
        return torch.empty(0, 3, dtype=torch.float64), torch.empty(0, 3, dtype=torch.long)
    # All blocks in a row; no cube lies between two. Its last corner stands for a cube.
    row, mask = distances.flatten(0, 1), F.pad(cubes, (1, 0, 1, 0, 1, 0)).flatten(0, 1)
    vertices, faces, _, _ = marching_cubes(row.numpy(), 0.0, mask=mask.numpy())
    vertices = torch.from_numpy(vertices.astype(np.float64))
    block = (vertices[:, 0] / (SIDE + 1)).long()
    vertices[:, 0] -= (SIDE + 1) * block
    return vertices + SIDE * blocks[block], torch.from_numpy(faces.astype(np.int64))


def _mean_colors(
    vertices: Float[Tensor, "P 3"],
    depths: Float[Tensor, "V H W"],
    images: Float[Tensor, "V 3 H W"],
    cameras: Cameras,
    truncation: float,
) -> Float[Tensor, "P 3"]:
    """Compute the mean color over the views that see a vertex within a truncation.

    Without any: over what lies before or behind it; else gray.
    """
    total, weight = torch.zeros(len(vertices), 3), torch.zeros(len(vertices), 1)
    for view, (depth, image) in enumerate(zip(depths, images, strict=True)):
        pixels, z, inside = (part[0] for part in cameras.select([view]).project(vertices))
        x, y = pixels[inside].long().unbind(-1)
        sees = (depth[y, x] - z[inside]).abs() < truncation
        part = torch.where(sees, 1, UNSEEN * depth[y, x].isfinite())[:, None]
        total[inside] += part * image[:, y, x].T
        weight[inside] += part
    return (total / weight).nan_to_num(0.5)
