"""Color and depth along rays: Lambert shading, highlights, one hard shadow, ambient occlusion."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.random import Generator
from torch import Tensor

from asysplat.data.procedural.floor_plan import SKY_RADIUS, FloorPlan
from asysplat.data.procedural.geometry import (
    TINY,
    Boxes,
    Cone,
    Index,
    Origins,
    PerRay,
    Points,
    Room,
    Spheres,
    Terrain,
)
from asysplat.data.procedural.textures import Material, albedo, fractal_noise, noise_lattice

OCCLUSION_DISTANCE = 0.4  # meters over which a near surface reduces ambient light
MIN_AMBIENT = 0.25  # fraction of the ambient light in a corner
SHADOW_OFFSET = 2e-3  # meters from a surface to the start of its shadow rays
SPHERE_AXES = ((0.8, 0.1, 0.6), (-0.2, 0.95, 0.25))  # texture axes
ZENITH = (0.25, 0.45, 0.9)
HORIZON = (0.85, 0.9, 1.0)
REFINE_STEPS = 8  # steps to refine the point where a ray meets the ground
BLOCK = 64  # rays that torch sums at once, or a multiple
SKY = -1  # its number as a surface

Surface = Int[Tensor, " R"]


class World:
    """A floor plan as tensors on one device."""

    def __init__(self, plan: FloorPlan, rng: Generator, device: torch.device):
        def tensor(values) -> Tensor:
            return torch.as_tensor(np.asarray(values, np.float32), device=device)

        centers, halves, yaws, _ = zip(*plan.boxes, strict=True)
        turns = [(np.cos(yaw), np.sin(yaw)) for yaw in yaws]
        axes = np.array([[[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]] for cos, sin in turns])
        self._boxes = Boxes(tensor(centers), tensor(halves), tensor(axes))
        centers, radii, _ = zip(*plan.spheres, strict=True)
        self._spheres = Spheres(tensor(centers), tensor(radii))
        self._dome = Spheres(tensor(np.zeros((1, 3))), tensor([SKY_RADIUS]))
        if plan.room is not None:
            self._enclosure = Room(*map(tensor, plan.room))
        else:
            assert plan.heights is not None  # outdoors
            spacing = 2 * SKY_RADIUS / (len(plan.heights) - 1)
            slopes = np.gradient(plan.heights, spacing)[::-1]
            self._enclosure = Terrain(tensor([plan.heights, *slopes]), SKY_RADIUS)
        self._glossy = any(material.gloss for material in plan.materials())
        self._surfaces = tensor(_surface_rows(plan, axes, rng)).T.contiguous()
        # Surfaces are numbered: three pairs of faces a box, spheres, walls or ground.
        self._first_sphere = 3 * len(plan.boxes)
        self._shell = self._first_sphere + len(plan.spheres)
        self._lattice = tensor(noise_lattice(rng))
        self._light = tensor(plan.light)[:, None]
        self._falloff = plan.falloff
        self._irradiance = tensor(plan.irradiance)[:, None]
        self._ambient = tensor(plan.ambient)[:, None]
        self._sky = tensor((HORIZON, ZENITH))[..., None]

    def trace(
        self, origins: Origins, directions: Points, pixel: float
    ) -> tuple[Points, PerRay, Surface]:
        """Return linear color, t and surface of the nearest hits; `pixel` is its width at t = 1."""
        cone = Cone.around(origins, directions)
        boxes, spheres = self._boxes.within(cone), self._spheres.within(cone)
        t, surface = self._nearest(origins, directions, boxes, spheres, REFINE_STEPS)
        points = origins + t * directions
        color = torch.empty_like(points)
        sky, solid = _padded_rays(surface == SKY), _padded_rays(surface != SKY)
        if len(sky):
            color[:, sky] = self._sky_color(points[:, sky])
        if len(solid):
            color[:, solid] = self._surface_color(
                points[:, solid], directions[:, solid], surface[solid], pixel * t[solid], cone
            )
        return color, t, surface

    def _surface_color(
        self, points: Points, directions: Points, surface: Surface, widths: PerRay, cone: Cone
    ) -> Points:
        """Compute the linear color of points; `widths` are those of a pixel there, in meters."""
        rows = self._surfaces.index_select(1, surface)
        along_u, along_v, offset, flat, curvature, material = rows.split((3, 3, 2, 3, 1, 16))
        normals = torch.where(curvature > 0, (points - flat) * curvature, flat)
        if isinstance(self._enclosure, Terrain):
            normals = torch.where(surface < self._shell, normals, self._enclosure.normals(points))
        cosine = (normals * directions).sum(0)
        normals = normals * -cosine.sign()
        uv = torch.stack(((along_u * points).sum(0), (along_v * points).sum(0))) + offset
        # A slanted pixel covers more of the surface; with the root, the mean of its two widths.
        footprint = widths / cosine.abs().clamp(0.1, 1).sqrt()
        direct = self._direct(points, normals)
        light = self._irradiance * direct + self._ambient * self._openness(points, normals, cone)
        color = albedo(self._lattice, material, uv, footprint) * light
        if self._glossy:
            gloss, shininess = material[-2:]
            # Cosine between the normal and the half vector of eye and light (Blinn, 1977).
            to_light = self._light - points
            half = to_light * (to_light * to_light).sum(0).rsqrt()
            half = half - directions * (directions * directions).sum(0).rsqrt()
            cosine = (normals * half).sum(0).clamp(min=0)
            cosine = cosine * (half * half).sum(0).clamp(min=TINY).rsqrt()
            highlight = gloss * cosine**shininess
            color = color + self._irradiance * (direct * highlight)
        return color

    def surfaces(self, origins: Origins, directions: Points, candidates: Index) -> Surface:
        """Return which of the `candidates` each ray hits first, numbered as in `trace`."""
        tested = torch.zeros(self._surfaces.shape[1] + 1, dtype=torch.bool, device=self._sky.device)
        tested[candidates] = True  # the last is the sky
        tested[0] = tested[self._first_sphere] = True  # at least one box and one sphere
        boxes = tested[: self._first_sphere].view(-1, 3).any(1).nonzero()[:, 0]
        spheres = tested[self._first_sphere : self._shell].nonzero()[:, 0]
        return self._nearest(origins, directions, boxes, spheres, refine_steps=1)[1]

    def _nearest(
        self, origins: Origins, directions: Points, boxes: Index, spheres: Index, refine_steps: int
    ) -> tuple[PerRay, Surface]:
        """Return the t and surface of the nearest hit, among the given boxes and spheres."""
        box_t, box = self._boxes.select(boxes).hit(origins, directions).min(0)
        sphere_t, sphere = self._spheres.select(spheres).hit(origins, directions).min(0)
        box, sphere = boxes[box], spheres[sphere]
        face = self._boxes.facing(origins + box_t * directions, box)
        surface = torch.where(box_t <= sphere_t, 3 * box + face, self._first_sphere + sphere)
        t = torch.minimum(box_t, sphere_t)
        sky_t = self._dome.leave(origins, directions)[0]
        if isinstance(self._enclosure, Room):
            shell_t, wall = self._enclosure.hit(origins, directions)
        else:
            t = torch.minimum(t, sky_t)
            shell_t, wall = self._enclosure.hit(origins, directions, t, refine_steps), 0
        surface = torch.where(shell_t < t, self._shell + wall, surface)
        t = torch.minimum(t, shell_t)
        return t, torch.where(t >= sky_t, SKY, surface)

    def _direct(self, points: Points, normals: Points) -> PerRay:
        """Compute the fraction of the light that arrives directly from its source."""
        to_light = self._light - points
        distance = (to_light * to_light).sum(0).sqrt()
        direct = (normals * to_light).sum(0).clamp(min=0) / distance
        direct = direct / (1 + (distance / self._falloff) ** 2)
        # Points that face away from the light need no shadow ray.
        lit = direct.nonzero()[:, 0]
        if len(lit):
            start, to_light = (points + SHADOW_OFFSET * normals)[:, lit], to_light[:, lit]
            solids = self._near(Cone.around(self._light, start - self._light))
            by_box, by_sphere = (solid.hit(start, to_light).amin(0) < 1 for solid in solids)
            direct[lit[by_box | by_sphere]] = 0
        return direct

    def _near(self, cone: Cone, margin: float = 0.0) -> tuple[Boxes, Spheres]:
        boxes, spheres = self._boxes.within(cone, margin), self._spheres.within(cone, margin)
        return self._boxes.select(boxes), self._spheres.select(spheres)

    def _openness(self, points: Points, normals: Points, cone: Cone) -> PerRay:
        """Compute the fraction of the ambient light that arrives: less near other objects."""
        points = points + OCCLUSION_DISTANCE * normals
        if isinstance(self._enclosure, Room):
            shell = self._enclosure.distance(points)
        else:
            shell = self._enclosure.above(points[:, None])[0]
        # Once from the cone's surface hits to the points, and once from there to the objects.
        boxes, spheres = self._near(cone, 2 * OCCLUSION_DISTANCE)
        gap = torch.minimum(shell, torch.minimum(boxes.distance(points), spheres.distance(points)))
        return MIN_AMBIENT + (1 - MIN_AMBIENT) * (gap / OCCLUSION_DISTANCE).clamp(0, 1)

    def _sky_color(self, points: Points) -> Points:
        elevation = (points[2] / SKY_RADIUS).clamp(0, 1)
        horizon, zenith = self._sky
        clear = horizon + (zenith - horizon) * elevation.sqrt()
        uv = points[:2] / (SKY_RADIUS * (elevation + 0.25))
        clouds = fractal_noise(self._lattice, uv * 2, torch.full_like(elevation, 0.1))[0]
        return clear + (1 - clear) * clouds.clamp(0, 1)


def _padded_rays(mask: Bool[Tensor, " R"]) -> Index:
    rays = mask.nonzero()[:, 0]
    # Torch sums the end of a row in another order; padding keeps every ray's rounding the same.
    return torch.cat((rays, rays[-1:].expand(-len(rays) % BLOCK)))


def _surface_rows(
    plan: FloorPlan, axes: Float[np.ndarray, "B 3 3"], rng: Generator
) -> Float[np.ndarray, "S K"]:
    """Return a row for each pair of faces of a box, each sphere, and each wall or the ground."""
    # The texture's axes and offset; normal and 0, or center and 1 / radius; the material.
    rows = []

    def add(u, v, normal, curvature: float, material: Material) -> None:
        offset = rng.uniform(0, 30, 2)
        rows.append([*u, *v, *offset, *normal, curvature, *material.row()])

    for (x, y, z), (*_, material) in zip(axes, plan.boxes, strict=True):
        for face in ((y, z, x), (x, z, y), (x, y, z)):
            add(*face, 0.0, material)
    for center, radius, material in plan.spheres:
        add(*SPHERE_AXES, center, 1 / radius, material)
    x, y, z = np.eye(3)
    walls = [(y, z, x)] * 2 + [(x, z, y)] * 2 + [(x, y, z)] * 2
    ground = [(x, y, z)]
    for face, material in zip(ground if plan.room is None else walls, plan.shell, strict=True):
        add(*face, 0.0, material)
    return np.array(rows)
