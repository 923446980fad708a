"""Random floor plans of a room or an outdoor place, around a camera path.

All in meters, z up, the floor at about 0, the path around the origin.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from asysplat.data.procedural import textures
from asysplat.data.procedural.textures import Material

CLEARANCE = 0.45  # horizontal distance between the path and objects on the ground
SKY_RADIUS = 60.0
TERRAIN_SAMPLES = 121
TRIES = 64  # random spots for each object


@dataclass
class FloorPlan:
    """All solid objects, and the light; colors are linear RGB."""

    walk: Float[np.ndarray, "T 2"]  # camera positions from above; objects keep clear of them
    light: np.ndarray  # position of the lamp or sun
    irradiance: np.ndarray  # irradiance of a surface that faces the light from close by
    falloff: float  # distance at which the light is half as strong
    ambient: np.ndarray  # light from all directions
    shell: list[Material]  # walls at +-x, +-y, ceiling and floor; outdoors the ground
    room: tuple[np.ndarray, np.ndarray] | None = None  # lower and upper corner; None outdoors
    heights: np.ndarray | None = None  # [N, N] of the terrain; None in a room
    # (center, half sizes, yaw in radians, material), (center, radius, material), (spot, radius)
    boxes: list[tuple[np.ndarray, np.ndarray, float, Material]] = field(default_factory=list)
    spheres: list[tuple[np.ndarray, float, Material]] = field(default_factory=list)
    occupied: list[tuple[np.ndarray, float]] = field(default_factory=list)

    def add_box(self, center, half, yaw: float, material: Material) -> None:
        self.boxes.append((np.array(center, float), np.array(half, float), yaw, material))

    def add_sphere(self, center, radius: float, material: Material) -> None:
        self.spheres.append((np.array(center, float), radius, material))

    def materials(self) -> list[Material]:
        """Return the distinct materials."""
        solids = (*self.boxes, *self.spheres)
        return list(dict.fromkeys([*(solid[-1] for solid in solids), *self.shell]))

    def place(self, spots: Float[np.ndarray, "K 2"], radius: float) -> np.ndarray | None:
        """Occupy the first spot with room for a disc; None if there is none."""
        to_walk = np.linalg.norm(spots[:, None] - self.walk, axis=-1).min(1)
        free = to_walk > radius + CLEARANCE
        for spot, occupied_radius in self.occupied:
            free &= np.linalg.norm(spots - spot, axis=-1) > 0.85 * (radius + occupied_radius)
        if not free.any():
            return None
        self.occupied.append((spots[free.argmax()], radius))
        return spots[free.argmax()]


# Adds an object at x, y, of a size in meters.
AddObject = Callable[[FloorPlan, Generator, float, float, float], None]


def any_material(rng: Generator) -> Material:
    kinds = (textures.cloth, textures.planks, textures.tiles, textures.plaster, textures.cloth)
    return kinds[rng.integers(len(kinds))](rng)


def table(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a top on two panels, with a ball on it."""
    height, yaw, wood = rng.uniform(0.5, 0.8), rng.uniform(0, np.pi), textures.planks(rng)
    along = np.array([np.cos(yaw), np.sin(yaw)])
    plan.add_box((x, y, height - 0.03), (0.8 * size, 0.5 * size, 0.03), yaw, wood)
    for side in (-0.65, 0.65):
        leg = np.array([x, y]) + side * size * along
        plan.add_box((*leg, height / 2 - 0.03), (0.03, 0.45 * size, height / 2 - 0.03), yaw, wood)
    radius = rng.uniform(0.1, 0.2)
    plan.add_sphere((x, y, height + radius), radius, any_material(rng))


def stack(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a crate with a smaller one on it."""
    half, yaw = np.array([0.75, 0.6, 0.6]) * size * rng.uniform(0.7, 1.0), rng.uniform(0, np.pi)
    plan.add_box((x, y, half[2]), half, yaw, any_material(rng))
    small = half * rng.uniform(0.35, 0.7)
    top = 2 * half[2] + small[2]
    plan.add_box((x, y, top), small, yaw + rng.uniform(-0.6, 0.6), any_material(rng))


def sofa(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a seat with a back."""
    yaw, fabric = rng.integers(4) * np.pi / 2 + rng.uniform(-0.15, 0.15), textures.cloth(rng)
    back = np.array([x, y]) + 0.42 * size * np.array([-np.sin(yaw), np.cos(yaw)])
    plan.add_box((x, y, 0.22), (0.85 * size, 0.5 * size, 0.22), yaw, fabric)
    plan.add_box((*back, 0.62), (0.85 * size, 0.1 * size, 0.2), yaw, fabric)


def ball(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    plan.add_sphere((x, y, 0.7 * size), 0.7 * size, any_material(rng))


def tree(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    height, crown = rng.uniform(1.5, 2.8), rng.uniform(0.8, 1.5)
    bark = textures.planks(rng)
    plan.add_box((x, y, height / 2 - 0.5), (0.12, 0.12, height / 2 + 0.5), rng.uniform(), bark)
    plan.add_sphere((x, y, height + 0.6 * crown), crown, textures.leaves(rng))


def boulder(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    kind = textures.stone if rng.random() < 0.6 else textures.leaves
    plan.add_sphere((x, y, rng.uniform(-0.1, 0.4) * size), size, kind(rng))


def house(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a block with a flat roof that juts out, and a dark door."""
    half = np.array([0.8, 0.6, rng.uniform(0.5, 1.0)]) * size
    yaw = rng.uniform(0, np.pi)
    wall = (textures.bricks, textures.plaster, textures.planks)[rng.integers(3)](rng)
    plan.add_box((x, y, half[2] - 0.5), half, yaw, wall)
    eaves = (half[0] + 0.25, half[1] + 0.25, 0.12)
    plan.add_box((x, y, 2 * half[2] - 0.4), eaves, yaw, textures.stone(rng))
    door = half * np.array([0.3, 1.01, 0.6])
    plan.add_box((x, y, door[2] - 0.3), door, yaw, textures.cloth(rng))


def scatter(
    plan: FloorPlan,
    rng: Generator,
    kinds: Sequence[tuple[AddObject, float, float]],
    spots: Callable[[], Float[np.ndarray, "K 2"]],
) -> None:
    """Add one object of each (kind, smallest size, largest size), if there is a free spot."""
    for kind, smallest, largest in kinds:
        size = rng.uniform(smallest, largest)
        spot = plan.place(spots(), size)
        if spot is not None:
            kind(plan, rng, *spot, size)


def decorate_walls(plan: FloorPlan, rng: Generator, half: np.ndarray) -> None:
    """Hang pictures and put cupboards along the walls."""
    for wall in range(4):
        axis, side = wall % 2, 1 if wall < 2 else -1
        for position in (-0.5, 0.5) if rng.random() < 0.5 else (rng.uniform(-0.5, 0.5),):
            center, size = np.zeros(3), np.zeros(3)
            center[axis] = side * half[axis]
            center[1 - axis] = position * half[1 - axis]
            deep = rng.random() < 0.4
            size[axis] = 0.3 if deep else 0.03
            size[1 - axis] = rng.uniform(0.35, 0.7)
            size[2] = rng.uniform(0.4, 1.1) if deep else rng.uniform(0.3, 0.6)
            center[2] = size[2] if deep else rng.uniform(1.4, 1.7)
            plan.add_box(center, size, 0.0, any_material(rng))


def furnished_room(rng: Generator, walk: Float[np.ndarray, "T 2"], half: np.ndarray) -> FloorPlan:
    """Furnish a room of the given half sizes, around the origin, with its floor at 0."""
    height = 2 * half[2]
    wall = (textures.plaster, textures.bricks, textures.planks, textures.plaster)[rng.integers(4)]
    wallpaper = wall(rng)
    accent = textures.cloth(rng) if rng.random() < 0.4 else textures.plaster(rng)
    floor = (textures.planks, textures.tiles)[rng.integers(2)](rng)
    lamp = np.array([*rng.uniform(-0.5, 0.5, 2) * half[:2], height - 0.5])
    plan = FloorPlan(
        walk=walk,
        light=lamp,
        irradiance=np.array([1.0, 0.9, 0.78]),
        falloff=rng.uniform(1.5, 3.0),
        ambient=rng.uniform(0.15, 0.3) * np.array([0.9, 0.95, 1.0]),
        shell=[wallpaper, accent, wallpaper, wallpaper, textures.plaster(rng), floor],
        room=(np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], height])),
    )
    decorate_walls(plan, rng, half)
    plan.add_sphere(lamp + np.array([0, 0, 0.4]), 0.15, textures.plaster(rng))
    rug = textures.cloth(rng)
    plan.add_box((0, 0, 0), (*rng.uniform(0.6, 1.2, 2), 0.015), rng.uniform(0, np.pi), rug)
    kinds = [(table, 0.5, 0.75), (stack, 0.35, 0.6), (sofa, 0.6, 0.9), (ball, 0.2, 0.4)]
    kinds += [(stack, 0.3, 0.5), (ball, 0.15, 0.4)]
    scatter(plan, rng, kinds, lambda: rng.uniform(-0.85, 0.85, (TRIES, 2)) * half[:2])
    return plan


def hills(rng: Generator) -> Float[np.ndarray, "N N"]:
    """Draw a height field: gentle near the origin, rising toward the horizon."""
    axis = np.linspace(-SKY_RADIUS, SKY_RADIUS, TERRAIN_SAMPLES)
    distance = np.hypot(axis[:, None], axis)
    height = np.zeros_like(distance)
    for wavelength in (50, 31, 17, 9):
        heading = rng.uniform(0, 2 * np.pi, 3)
        for angle, phase in zip(heading, rng.uniform(0, 2 * np.pi, 3), strict=True):
            along = np.cos(angle) * axis + np.sin(angle) * axis[:, None]
            height += wavelength / 60 * np.sin(2 * np.pi * along / wavelength + phase)
    rise = np.clip((distance - 5) / 25, 0, 1) ** 1.5
    return height * (0.06 + rng.uniform(1.0, 3.0) * rise) + rng.uniform(0, 4) * rise


def outdoor_place(rng: Generator, walk: Float[np.ndarray, "T 2"]) -> FloorPlan:
    """Put houses, trees, boulders and crates on hills, under a sun."""
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(20, 60))
    sun = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    plan = FloorPlan(
        walk=walk,
        light=1e3 * sun,
        irradiance=np.array([1.0, 0.92, 0.8]),
        falloff=1e6,
        ambient=rng.uniform(0.2, 0.4) * np.array([0.8, 0.9, 1.0]),
        shell=[(textures.grass, textures.grass, textures.stone)[rng.integers(3)](rng)],
        heights=hills(rng),
    )

    def ring(nearest: float, farthest: float) -> Float[np.ndarray, "K 2"]:
        angle = rng.uniform(0, 2 * np.pi, TRIES)
        radius = rng.uniform(nearest, farthest, TRIES)
        return np.stack((radius * np.cos(angle), radius * np.sin(angle)), 1)

    near = [(stack, 0.4, 0.7), (boulder, 0.3, 0.7), (boulder, 0.3, 0.6), (stack, 0.4, 0.6)]
    scatter(plan, rng, near, lambda: ring(0.0, 4.0))
    plan.add_sphere((*ring(12.0, 20.0)[0], 0), rng.uniform(1.5, 3), textures.leaves(rng))
    far = [(house, 2.0, 3.5), (house, 2.0, 3.5), (tree, 1.2, 1.2), (tree, 1.2, 1.2)]
    far += [(tree, 1.2, 1.2), (boulder, 0.6, 1.2), (house, 2.0, 3.0)]
    scatter(plan, rng, far, lambda: ring(4.5, 11.0))
    return plan
