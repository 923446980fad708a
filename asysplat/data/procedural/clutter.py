"""Details of real places that plain floor plans lack: thin and small near objects, gloss."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from asysplat.data.procedural import textures
from asysplat.data.procedural.floor_plan import TRIES, FloorPlan, any_material, scatter
from asysplat.data.procedural.textures import Material

UNDERGROUND = 0.5  # meters of a pole below the floor, as ground outdoors is not level
GLOSSY_PROBABILITY = 0.5  # probability that a material is glossy


def add_clutter(plan: FloorPlan, rng: Generator) -> None:
    """Add an object on thin legs, a stand, a lamp or a pipe, and an object on top of a box."""
    legged = (trestle, railing)[rng.integers(2)]
    beside_walk = [(stand, 0.12, 0.12)]
    if rng.random() < 0.5:
        beside_walk.append((lamp, 0.12, 0.2))
    else:
        pipe(plan, rng)
    scatter(plan, rng, [(legged, 0.5, 0.8)], lambda: rng.uniform(-3, 3, (TRIES, 2)))
    scatter(plan, rng, beside_walk, lambda: _near_walk(plan, rng))
    put_on_top(plan, rng)


def polish(plan: FloorPlan, rng: Generator) -> None:
    """Make some of the materials glossy."""
    polished = {material: material for material in plan.materials()}
    for material in polished:
        if rng.random() <= GLOSSY_PROBABILITY:
            gloss, shininess = rng.uniform(0.2, 1.2), np.exp(rng.uniform(2, 5))
            polished[material] = replace(material, gloss=gloss, shininess=shininess)
    plan.boxes = [(center, half, yaw, polished[m]) for center, half, yaw, m in plan.boxes]
    plan.spheres = [(center, radius, polished[m]) for center, radius, m in plan.spheres]
    plan.shell = [polished[material] for material in plan.shell]


def _near_walk(plan: FloorPlan, rng: Generator) -> Float[np.ndarray, "K 2"]:
    angle = rng.uniform(0, 2 * np.pi, TRIES)
    offset = rng.uniform(0.6, 1.5, TRIES) * np.array([np.cos(angle), np.sin(angle)])
    return plan.walk[rng.integers(len(plan.walk), size=TRIES)] + offset.T


def pole(plan: FloorPlan, x: float, y: float, top: float, half: float, material: Material) -> None:
    """Add an upright pole; `half` is half its width in meters."""
    middle, half_height = (top - UNDERGROUND) / 2, (top + UNDERGROUND) / 2
    plan.add_box((x, y, middle), (half, half, half_height), 0.0, material)


def trestle(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a table or bench on four thin legs."""
    height, yaw, wood = rng.uniform(0.4, 0.9), rng.uniform(0, np.pi), any_material(rng)
    half = np.array([0.8, rng.uniform(0.3, 0.5)]) * size
    plan.add_box((x, y, height), (*half, 0.02), yaw, wood)
    along, across = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    thin, metal = rng.uniform(0.012, 0.025), any_material(rng)
    for side in (-0.9, 0.9):
        for end in (-0.9, 0.9):
            leg = np.array([x, y]) + side * half[0] * along + end * half[1] * across
            pole(plan, *leg, height, thin, metal)


def railing(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add two rails on two posts."""
    height, yaw, metal = rng.uniform(0.7, 1.1), rng.uniform(0, np.pi), any_material(rng)
    thin = rng.uniform(0.015, 0.03)
    along = np.array([np.cos(yaw), np.sin(yaw)])
    for rail in (height, 0.5 * height):
        plan.add_box((x, y, rail), (size, thin, thin), yaw, metal)
    for end in (-0.95, 0.95):
        pole(plan, *(np.array([x, y]) + end * size * along), height, thin, metal)


def stand(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a pole with a small object on it."""
    height, material = rng.uniform(0.5, 1.4), any_material(rng)
    pole(plan, x, y, height, rng.uniform(0.012, 0.025), any_material(rng))
    half = rng.uniform(0.05, 0.12)
    if rng.random() < 0.5:
        plan.add_sphere((x, y, height + half), half, material)
    else:
        sides = half * rng.uniform((0.5, 0.2, 0.4), 0.8)
        plan.add_box((x, y, height + sides[2]), sides, rng.uniform(0, np.pi), material)


def lamp(plan: FloorPlan, rng: Generator, x: float, y: float, size: float) -> None:
    """Add a tall pole with a globe."""
    height = rng.uniform(1.4, 1.8)
    pole(plan, x, y, height, rng.uniform(0.012, 0.025), any_material(rng))
    plan.add_sphere((x, y, height + 0.8 * size), 0.8 * size, textures.plaster(rng))


def pipe(plan: FloorPlan, rng: Generator) -> None:
    """Hang a pipe or a cable across the place; in a room, above the lamp."""
    height = rng.uniform(2.0, 2.5) if plan.room is None else plan.light[2] + 0.15
    center = (*rng.uniform(-1.5, 1.5, 2), height)
    thin = rng.uniform(0.012, 0.035)
    plan.add_box(center, (30.0, thin, thin), rng.uniform(0, np.pi), any_material(rng))


def put_on_top(plan: FloorPlan, rng: Generator) -> None:
    """Put a small object on a box that is wide enough and at most as high as a table."""
    tops = [
        (center, half, yaw)
        for center, half, yaw, _ in plan.boxes
        if half[:2].min() > 0.2 and 0.3 < center[2] + half[2] < 1.2
    ]
    for index in rng.permutation(len(tops))[:1]:
        center, half, yaw = tops[index]
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y = rng.uniform(-0.8, 0.8, 2) * half[:2]
        size = rng.uniform(0.03, 0.1)
        position = center + np.array([cos * x - sin * y, sin * x + cos * y, half[2] + size])
        if rng.random() < 0.5:
            plan.add_sphere(position, size, any_material(rng))
        else:
            sides = size * np.array([*rng.uniform(0.3, 1.0, 2), 1.0])
            plan.add_box(position, sides, rng.uniform(0, np.pi), any_material(rng))
