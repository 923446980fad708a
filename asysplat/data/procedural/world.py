"""Light and depth along rays: Lambert shading, one hard shadow, soft corners."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.data.procedural.floor_plan import SKY_RADIUS, FloorPlan
from asysplat.data.procedural.geometry import Boxes, Room, Spheres, Terrain
from asysplat.data.procedural.textures import Material, albedo, fractal_noise, noise_lattice

CORNER_DISTANCE = 0.4  # metres over which a near surface takes away ambient light
CORNER_LIGHT = 0.25  # share of ambient light that is left in a corner
OFF_SURFACE = 2e-3  # metres by which shadow rays start above the surface
SLANT = ((0.8, 0.1, 0.6), (-0.2, 0.95, 0.25))  # texture axes of spheres
ZENITH = (0.25, 0.45, 0.9)
HORIZON = (0.85, 0.9, 1.0)


class World:
    """A floor plan as tensors on one device."""

    def __init__(self, plan: FloorPlan, rng: np.random.Generator, device: torch.device):
        def tensor(values) -> Tensor:
            return torch.as_tensor(np.asarray(values, np.float32), device=device)

        centers, halves, yaws, _ = zip(*plan.boxes, strict=True)
        axes = np.stack([_yaw_axes(yaw) for yaw in yaws])
        self._boxes = Boxes(tensor(centers), tensor(halves), tensor(axes))
        centers, radii, _ = zip(*plan.spheres, strict=True)
        self._spheres = Spheres(tensor(centers), tensor(radii))
        self._dome = Spheres(tensor(np.zeros((1, 3))), tensor([SKY_RADIUS]))
        self._room = None if plan.room is None else Room(*map(tensor, plan.room))
        self._terrain = None
        if plan.heights is not None:
            spacing = 2 * SKY_RADIUS / (len(plan.heights) - 1)
            slopes = np.gradient(plan.heights, spacing)[::-1]
            self._terrain = Terrain(tensor([plan.heights, *slopes]), SKY_RADIUS)
        self._surfaces = tensor(_surface_rows(plan, axes, rng)).T.contiguous()
        self._shell = 3 * len(plan.boxes) + len(plan.spheres)
        self._lattice = tensor(noise_lattice(rng))
        self._light = tensor(plan.light)[:, None]
        self._falloff = plan.falloff
        self._light_colour = tensor(plan.light_colour)[:, None]
        self._ambient = tensor(plan.ambient)[:, None]
        self._sky = tensor((HORIZON, ZENITH))[..., None]

    def trace(
        self, origin: Float[Tensor, "3 1"], directions: Float[Tensor, "3 R"], pixel: float
    ) -> tuple[Float[Tensor, "3 R"], Float[Tensor, " R"]]:
        """Return the linear colour and t of the nearest hit of rays origin + t * direction.

        Args:
            pixel: width of a pixel at t = 1, metres.
        """
        t, surface, in_sky = self._nearest(origin, directions)
        points = origin + t * directions
        rows = self._surfaces.index_select(1, surface)
        along_u, along_v, offset, flat, curvature, material = rows.split((3, 3, 2, 3, 1, 14))
        normals = torch.where(curvature > 0, (points - flat) * curvature, flat)
        if self._terrain is not None:
            normals = torch.where(surface < self._shell, normals, self._terrain.normals(points))
        cosine = (normals * directions).sum(0)
        normals = normals * -cosine.sign()
        uv = torch.stack(((along_u * points).sum(0), (along_v * points).sum(0))) + offset
        # A slanted pixel covers more of the surface; with the root, the mean of its two widths.
        footprint = pixel * t / cosine.abs().clamp(0.1, 1).sqrt()
        colour = albedo(self._lattice, material, uv, footprint) * self._shade(points, normals)
        if self._terrain is not None:
            colour = torch.where(in_sky, self._sky_colour(points), colour)
        return colour, t

    def _nearest(
        self, origin: Float[Tensor, "3 1"], directions: Float[Tensor, "3 R"]
    ) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"], Bool[Tensor, " R"]]:
        """Return the t and surface of the nearest hit, and whether it is the sky."""
        box_t, box = self._boxes.hit(origin, directions).min(0)
        sphere_t, sphere = self._spheres.hit(origin, directions).min(0)
        face = self._boxes.facing(origin + box_t * directions, box)
        num_boxes = len(self._boxes.centers)
        surface = torch.where(box_t <= sphere_t, 3 * box + face, 3 * num_boxes + sphere)
        t = torch.minimum(box_t, sphere_t)
        sky_t = self._dome.leave(origin, directions)[0]
        if self._room is not None:
            shell_t, wall = self._room.hit(origin, directions)
        else:
            t = torch.minimum(t, sky_t)
            shell_t, wall = self._terrain.hit(origin, directions, t), 0
        surface = torch.where(shell_t < t, self._shell + wall, surface)
        t = torch.minimum(t, shell_t)
        return t, surface, t >= sky_t

    def _shade(
        self, points: Float[Tensor, "3 R"], normals: Float[Tensor, "3 R"]
    ) -> Float[Tensor, "3 R"]:
        """Compute the light that a white surface reflects."""
        to_light = self._light - points
        distance = (to_light * to_light).sum(0).sqrt()
        direct = (normals * to_light).sum(0).clamp(min=0) / distance
        direct = direct / (1 + (distance / self._falloff) ** 2)
        start = points + OFF_SURFACE * normals
        blocked = (self._boxes.hit(start, to_light).amin(0) < 1) | (
            self._spheres.hit(start, to_light).amin(0) < 1
        )
        direct = torch.where(blocked, 0, direct)
        gap = self._distance(points + CORNER_DISTANCE * normals) / CORNER_DISTANCE
        open_sky = CORNER_LIGHT + (1 - CORNER_LIGHT) * gap.clamp(0, 1)
        return self._light_colour * direct + self._ambient * open_sky

    def _distance(self, points: Float[Tensor, "3 R"]) -> Float[Tensor, " R"]:
        """Return the distance from each point to the nearest thing; the ground's is vertical."""
        if self._room is not None:
            shell = self._room.distance(points)
        else:
            shell = self._terrain.above(points[:, None])[0]
        things = torch.minimum(self._boxes.distance(points), self._spheres.distance(points))
        return torch.minimum(shell, things)

    def _sky_colour(self, points: Float[Tensor, "3 R"]) -> Float[Tensor, "3 R"]:
        """Blend from a pale horizon to a blue zenith, with clouds."""
        elevation = (points[2] / SKY_RADIUS).clamp(0, 1)
        horizon, zenith = self._sky
        clear = horizon + (zenith - horizon) * elevation.sqrt()
        uv = points[:2] / (SKY_RADIUS * (elevation + 0.25))
        clouds = fractal_noise(self._lattice, uv * 2, torch.full_like(elevation, 0.1))[0]
        return clear + (1 - clear) * clouds.clamp(0, 1)


def _yaw_axes(yaw: float) -> Float[np.ndarray, "3 3"]:
    """Return the axes, as rows, of a box turned about the vertical."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def _surface_rows(
    plan: FloorPlan, axes: Float[np.ndarray, "B 3 3"], rng: np.random.Generator
) -> Float[np.ndarray, "S K"]:
    """Return a row for each box's three pairs of faces, each sphere, and the walls or the ground.

    Columns: the texture's two axes and its offset; normal and 0 for flat surfaces, centre and
    1 / radius for spheres; the material.
    """
    rows = []

    def add(u, v, normal, curvature: float, material: Material) -> None:
        offset = rng.uniform(0, 30, 2)
        rows.append([*u, *v, *offset, *normal, curvature, *material.row()])

    for (x, y, z), (*_, material) in zip(axes, plan.boxes, strict=True):
        add(y, z, x, 0.0, material)
        add(x, z, y, 0.0, material)
        add(x, y, z, 0.0, material)
    for center, radius, material in plan.spheres:
        add(*SLANT, center, 1 / radius, material)
    x, y, z = np.eye(3)
    walls = [(y, z, x)] * 2 + [(x, z, y)] * 2 + [(x, y, z)] * 2
    ground = [(x, y, z)]
    for place, material in zip(ground if plan.room is None else walls, plan.shell, strict=True):
        add(*place, 0.0, material)
    return np.array(rows)
