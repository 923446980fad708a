"""Light and depth along rays: Lambert shading, highlights, one hard shadow, soft corners."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.data.procedural.floor_plan import SKY_RADIUS, FloorPlan
from asysplat.data.procedural.geometry import TINY, Boxes, Cone, Room, Spheres, Terrain
from asysplat.data.procedural.textures import Material, albedo, fractal_noise, noise_lattice

CORNER_DISTANCE = 0.4  # meters over which a near surface takes away ambient light
CORNER_LIGHT = 0.25  # share of ambient light that is left in a corner
OFF_SURFACE = 2e-3  # meters by which shadow rays start above the surface
SLANT = ((0.8, 0.1, 0.6), (-0.2, 0.95, 0.25))  # texture axes of spheres
ZENITH = (0.25, 0.45, 0.9)
HORIZON = (0.85, 0.9, 1.0)
REFINE_STEPS = 8  # of where a ray meets the ground
BLOCK = 64  # rays that torch adds up at once, or a multiple
SKY = -1  # its number as a surface


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
        self._glossy = any(material.gloss for material in plan.materials())
        self._surfaces = tensor(_surface_rows(plan, axes, rng)).T.contiguous()
        self._shell = 3 * len(plan.boxes) + len(plan.spheres)
        self._lattice = tensor(noise_lattice(rng))
        self._light = tensor(plan.light)[:, None]
        self._falloff = plan.falloff
        self._light_color = tensor(plan.light_color)[:, None]
        self._ambient = tensor(plan.ambient)[:, None]
        self._sky = tensor((HORIZON, ZENITH))[..., None]

    def trace(
        self, origins: Float[Tensor, "3 #R"], directions: Float[Tensor, "3 R"], pixel: float
    ) -> tuple[Float[Tensor, "3 R"], Float[Tensor, " R"], Int[Tensor, " R"]]:
        """Return linear color, t and surface of the nearest hit of rays origin + t * direction.

        Args:
            pixel: width of a pixel at t = 1, meters.
        """
        cone = Cone.around(origins, directions)
        boxes, spheres = self._boxes.within(cone), self._spheres.within(cone)
        t, surface = self._nearest(origins, directions, boxes, spheres, REFINE_STEPS)
        points = origins + t * directions
        color = torch.empty_like(points)
        sky, solid = _rays_where(surface == SKY), _rays_where(surface != SKY)
        if len(sky):
            color[:, sky] = self._sky_color(points[:, sky])
        if len(solid):
            color[:, solid] = self._surface_color(
                points[:, solid], directions[:, solid], surface[solid], pixel * t[solid], cone
            )
        return color, t, surface

    def _surface_color(
        self,
        points: Float[Tensor, "3 R"],
        directions: Float[Tensor, "3 R"],
        surface: Int[Tensor, " R"],
        widths: Float[Tensor, " R"],
        cone: Cone,
    ) -> Float[Tensor, "3 R"]:
        """Compute the linear color of points, seen along rays of one cone.

        Args:
            widths: of a pixel at each point, meters.
        """
        rows = self._surfaces.index_select(1, surface)
        along_u, along_v, offset, flat, curvature, material = rows.split((3, 3, 2, 3, 1, 16))
        normals = torch.where(curvature > 0, (points - flat) * curvature, flat)
        if self._terrain is not None:
            normals = torch.where(surface < self._shell, normals, self._terrain.normals(points))
        cosine = (normals * directions).sum(0)
        normals = normals * -cosine.sign()
        uv = torch.stack(((along_u * points).sum(0), (along_v * points).sum(0))) + offset
        # A slanted pixel covers more of the surface; with the root, the mean of its two widths.
        footprint = widths / cosine.abs().clamp(0.1, 1).sqrt()
        direct = self._direct(points, normals)
        light = self._light_color * direct + self._ambient * self._openness(points, normals, cone)
        color = albedo(self._lattice, material, uv, footprint) * light
        if self._glossy:
            gloss, shininess = material[-2:]
            highlight = gloss * self._facing_half(points, normals, directions) ** shininess
            color = color + self._light_color * (direct * highlight)
        return color

    def surfaces(
        self,
        origins: Float[Tensor, "3 #R"],
        directions: Float[Tensor, "3 R"],
        among: Int[Tensor, " K"],
    ) -> Int[Tensor, " R"]:
        """Return the surface of the nearest hit of each ray, as `trace` numbers them.

        Where exactly the ground is met matters little to which surface is nearest.

        Args:
            among: surfaces to look for; what shows none of them is passed over.
        """
        shown = torch.zeros(self._surfaces.shape[1] + 1, dtype=torch.bool, device=among.device)
        shown[among] = True  # the last is the sky
        num_boxes = len(self._boxes.centers)
        shown[0] = shown[3 * num_boxes] = True  # never none
        boxes = shown[: 3 * num_boxes].view(-1, 3).any(1).nonzero()[:, 0]
        spheres = shown[3 * num_boxes : self._shell].nonzero()[:, 0]
        return self._nearest(origins, directions, boxes, spheres, refine_steps=1)[1]

    def _nearest(
        self,
        origins: Float[Tensor, "3 #R"],
        directions: Float[Tensor, "3 R"],
        boxes: Int[Tensor, " K"],
        spheres: Int[Tensor, " L"],
        refine_steps: int,
    ) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"]]:
        """Return the t and surface of the nearest hit.

        Args:
            boxes, spheres: the ones that rays may meet.
        """
        box_t, box = self._boxes.select(boxes).hit(origins, directions).min(0)
        sphere_t, sphere = self._spheres.select(spheres).hit(origins, directions).min(0)
        box, sphere = boxes[box], spheres[sphere]
        face = self._boxes.facing(origins + box_t * directions, box)
        num_boxes = len(self._boxes.centers)
        surface = torch.where(box_t <= sphere_t, 3 * box + face, 3 * num_boxes + sphere)
        t = torch.minimum(box_t, sphere_t)
        sky_t = self._dome.leave(origins, directions)[0]
        if self._room is not None:
            shell_t, wall = self._room.hit(origins, directions)
        else:
            t = torch.minimum(t, sky_t)
            shell_t, wall = self._terrain.hit(origins, directions, t, refine_steps), 0
        surface = torch.where(shell_t < t, self._shell + wall, surface)
        t = torch.minimum(t, shell_t)
        return t, torch.where(t >= sky_t, SKY, surface)

    def _direct(
        self, points: Float[Tensor, "3 R"], normals: Float[Tensor, "3 R"]
    ) -> Float[Tensor, " R"]:
        """Compute the share of the light that arrives straight from its source."""
        to_light = self._light - points
        distance = (to_light * to_light).sum(0).sqrt()
        direct = (normals * to_light).sum(0).clamp(min=0) / distance
        direct = direct / (1 + (distance / self._falloff) ** 2)
        # What turns away from the light needs no shadow ray.
        lit = direct.nonzero()[:, 0]
        if len(lit):
            start, to_light = (points + OFF_SURFACE * normals)[:, lit], to_light[:, lit]
            cone = Cone.around(self._light, start - self._light)
            boxes = self._boxes.select(self._boxes.within(cone))
            spheres = self._spheres.select(self._spheres.within(cone))
            blocked = (boxes.hit(start, to_light).amin(0) < 1) | (
                spheres.hit(start, to_light).amin(0) < 1
            )
            direct[lit[blocked]] = 0
        return direct

    def _openness(
        self, points: Float[Tensor, "3 R"], normals: Float[Tensor, "3 R"], cone: Cone
    ) -> Float[Tensor, " R"]:
        """Compute the share of the ambient light that arrives."""
        gap = self._distance(points + CORNER_DISTANCE * normals, cone) / CORNER_DISTANCE
        return CORNER_LIGHT + (1 - CORNER_LIGHT) * gap.clamp(0, 1)

    def _facing_half(
        self,
        points: Float[Tensor, "3 R"],
        normals: Float[Tensor, "3 R"],
        directions: Float[Tensor, "3 R"],
    ) -> Float[Tensor, " R"]:
        """Return the cosine between normal and half vector of eye and light (Blinn, 1977)."""
        to_light = self._light - points
        half = to_light * (to_light * to_light).sum(0).rsqrt()
        half = half - directions * (directions * directions).sum(0).rsqrt()
        return (normals * half).sum(0).clamp(min=0) * (half * half).sum(0).clamp(min=TINY).rsqrt()

    def _distance(self, points: Float[Tensor, "3 R"], cone: Cone) -> Float[Tensor, " R"]:
        """Return the distance from each point to the nearest thing; the ground's is vertical.

        Things that are farther than CORNER_DISTANCE may be left out.
        """
        if self._room is not None:
            shell = self._room.distance(points)
        else:
            shell = self._terrain.above(points[:, None])[0]
        # Points are that far from what the cone holds, and things that far from the points.
        reach = 2 * CORNER_DISTANCE
        boxes = self._boxes.select(self._boxes.within(cone, reach))
        spheres = self._spheres.select(self._spheres.within(cone, reach))
        things = torch.minimum(boxes.distance(points), spheres.distance(points))
        return torch.minimum(shell, things)

    def _sky_color(self, points: Float[Tensor, "3 R"]) -> Float[Tensor, "3 R"]:
        """Blend from a pale horizon to a blue zenith, with clouds."""
        elevation = (points[2] / SKY_RADIUS).clamp(0, 1)
        horizon, zenith = self._sky
        clear = horizon + (zenith - horizon) * elevation.sqrt()
        uv = points[:2] / (SKY_RADIUS * (elevation + 0.25))
        clouds = fractal_noise(self._lattice, uv * 2, torch.full_like(elevation, 0.1))[0]
        return clear + (1 - clear) * clouds.clamp(0, 1)


def _rays_where(chosen: Bool[Tensor, " R"]) -> Int[Tensor, " K"]:
    """Return the numbers of the chosen rays, the last one repeated up to a whole block.

    Torch adds up the end of a row in another order; so every ray is rounded as among all the rays.
    """
    rays = chosen.nonzero()[:, 0]
    return torch.cat((rays, rays[-1:].expand(-len(rays) % BLOCK)))


def _yaw_axes(yaw: float) -> Float[np.ndarray, "3 3"]:
    """Return the axes, as rows, of a box turned about the vertical."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])


def _surface_rows(
    plan: FloorPlan, axes: Float[np.ndarray, "B 3 3"], rng: np.random.Generator
) -> Float[np.ndarray, "S K"]:
    """Return a row for each box's three pairs of faces, each sphere, and the walls or the ground.

    Columns: the texture's two axes and its offset; normal and 0 for flat surfaces, center and
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
