"""Rays against boxes, spheres, a room's walls, a terrain and the sky dome.

Points and directions are component-major, [3, R], so that every operation runs over long rows.
Directions need no unit length: a hit at t lies at origin + t * direction. A miss is infinity.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.scene import TensorRecord

MARCH_STEPS = 18
TINY = 1e-20  # avoids division by 0
ANGLE_ROUNDING = 1e-3  # radians, more than the error of computed angles
MIN_GROUND_T = 0.5  # no ray meets the ground before this t, as cameras are at eye level

Points = Float[Tensor, "3 R"]  # or directions
Origins = Float[Tensor, "3 #R"]  # origins of rays, or one for all
PerRay = Float[Tensor, " R"]
Index = Int[Tensor, "_"]  # any number of indices
SomeSolids = TypeVar("SomeSolids", bound="Solids")


@dataclass(frozen=True)
class Cone:
    """A cone around rays from one point, to cull objects outside of it."""

    apex: Float[Tensor, " 3"]
    axis: Float[Tensor, " 3"]  # unit vector
    angle: Float[Tensor, ""]  # between the axis and the side, radians

    @classmethod
    def around(cls, origins: Origins, directions: Points) -> "Cone":
        """Return the narrowest cone about the mean direction; with several origins, all space."""
        unit = directions * (directions * directions).sum(0).rsqrt()
        mean = unit.mean(1)
        axis = mean / mean.norm()
        one = origins.shape[1] == 1
        angle = (axis @ unit).amin().clamp(-1, 1).acos() if one else axis.new_tensor(torch.pi)
        return cls(origins[:, 0], axis, angle)

    def meets(self, centers: Float[Tensor, "S 3"], radii: Float[Tensor, " S"]) -> Index:
        """Return the spheres that reach into the cone, and maybe some more; always at least one."""
        to_center = centers - self.apex
        distance = to_center.norm(dim=1)
        off_axis = (to_center @ self.axis / distance).clamp(-1, 1).acos()
        gap = off_axis - (radii / distance).clamp(max=1).asin() - self.angle
        return (gap <= gap.min().clamp(min=ANGLE_ROUNDING)).nonzero()[:, 0]


@dataclass(frozen=True)
class Solids(TensorRecord, ABC):
    """Convex objects."""

    centers: Float[Tensor, "S 3"]

    @abstractmethod
    def bounding_radii(self) -> Float[Tensor, " S"]:
        """Return the radius of a sphere around each center that holds the object."""

    def within(self, cone: Cone, margin: float = 0.0) -> Index:
        """Return the objects nearer to the cone than `margin`, as `Cone.meets` does."""
        return cone.meets(self.centers, self.bounding_radii() + margin)

    def select(self: SomeSolids, index: Index) -> SomeSolids:
        return self.map(lambda values: values[index])


@dataclass(frozen=True)
class Boxes(Solids):
    """Solid boxes; the rows of `axes` are a box's own axes in the world."""

    centers: Float[Tensor, "B 3"]
    halves: Float[Tensor, "B 3"]
    axes: Float[Tensor, "B 3 3"]

    def bounding_radii(self) -> Float[Tensor, " B"]:
        return self.halves.norm(dim=1)

    def _to_centers(self, points: Points) -> Float[Tensor, "3 B R"]:
        centers = torch.einsum("bij,bj->ib", self.axes, self.centers).reshape(-1, 1)
        offsets = torch.addmm(centers, self._axes_first(), points, alpha=-1)
        return offsets.view(3, len(self.centers), points.shape[1])

    def _axes_first(self) -> Float[Tensor, "axes 3"]:
        return self.axes.transpose(0, 1).reshape(-1, 3)

    def hit(self, origins: Origins, directions: Points) -> Float[Tensor, "B R"]:
        """Return the t at which each ray enters each box (slab test; Kay and Kajiya, 1986)."""
        # In place, as memory traffic takes most of the time.
        local = (self._axes_first() @ directions).view(3, len(self.centers), -1)
        inverse = local.add_(TINY).reciprocal_()
        middle = self._to_centers(origins) * inverse
        half_span = inverse.abs_().mul_(self.halves.T[..., None])
        enter, leave = (middle - half_span).amax(0), middle.add_(half_span).amin(0)
        return torch.where((enter <= leave) & (enter > 0), enter, torch.inf)

    def facing(self, points: Points, box: Int[Tensor, " R"]) -> Int[Tensor, " R"]:
        """Return the axis of its box that is normal to each point's face."""
        to_box = self.axes / self.halves[..., None]
        offset = points - self.centers.T.index_select(1, box)
        local = (to_box.permute(1, 2, 0).index_select(2, box) * offset).sum(1)
        x, y, z = local.abs()
        return torch.where(z > torch.maximum(x, y), 2, (y > x).long())

    def distance(self, points: Points) -> PerRay:
        """Return the distance from each point to the nearest box; 0 inside."""
        outside = (self._to_centers(points).abs() - self.halves.T[..., None]).clamp(min=0)
        return (outside * outside).sum(0).amin(0).sqrt()


@dataclass(frozen=True)
class Spheres(Solids):
    """Solid spheres."""

    centers: Float[Tensor, "S 3"]
    radii: Float[Tensor, " S"]

    def bounding_radii(self) -> Float[Tensor, " S"]:
        return self.radii

    def hit(self, origins: Origins, directions: Points) -> Float[Tensor, "S R"]:
        """Return the t at which each ray enters each sphere."""
        nearest, half_chord = self._chord(origins, directions)
        enter = nearest - half_chord
        return torch.where(enter > 0, enter, torch.inf)

    def leave(self, origins: Origins, directions: Points) -> Float[Tensor, "S R"]:
        """Return the t at which each ray leaves each sphere, for origins inside."""
        nearest, half_chord = self._chord(origins, directions)
        return nearest + half_chord

    def _chord(
        self, origins: Origins, directions: Points
    ) -> tuple[Float[Tensor, "S R"], Float[Tensor, "S R"]]:
        """Return the t of the middle of each ray's chord, and half its length; NaN for a miss."""
        square = (directions * directions).sum(0)
        to_center = self.centers[..., None] - origins
        nearest = (to_center * directions).sum(1) / square
        offset = nearest[:, None] * directions
        torch.sub(to_center, offset, out=offset)
        half_square = self.radii[:, None] ** 2 - offset.mul_(offset).sum(1)
        return nearest, (half_square / square).sqrt()

    def distance(self, points: Points) -> PerRay:
        """Return the distance from each point to the nearest sphere; 0 inside."""
        offset = points - self.centers[..., None]
        return ((offset * offset).sum(1).sqrt() - self.radii[:, None]).amin(0).clamp(min=0)


@dataclass(frozen=True)
class Room:
    """The inside of an axis-aligned box."""

    lower: Float[Tensor, " 3"]
    upper: Float[Tensor, " 3"]

    def hit(self, origins: Origins, directions: Points) -> tuple[PerRay, Int[Tensor, " R"]]:
        """Return the t and the wall (+x -x +y -y +z -z) that each ray from inside meets."""
        forward = directions > 0
        ahead = torch.where(forward, self.upper[:, None] - origins, origins - self.lower[:, None])
        t, axis = (ahead / directions.abs()).min(0)
        return t, 2 * axis + 1 - forward.gather(0, axis[None])[0].long()

    def distance(self, points: Points) -> PerRay:
        """Return the distance from each point inside to the nearest wall."""
        return torch.minimum(points - self.lower[:, None], self.upper[:, None] - points).amin(0)


@dataclass(frozen=True)
class Terrain:
    """A height field over the square [-extent, extent]^2, bilinear between its samples."""

    field: Float[Tensor, "3 N N"]  # height and its slopes along x and y, rows along y
    extent: float

    def sample(
        self, x: Float[Tensor, "T R"], y: Float[Tensor, "T R"], channels: slice
    ) -> Float[Tensor, "C T R"]:
        """Interpolate channels of the field; outside the square, repeat its border."""
        return torch.nn.functional.grid_sample(
            self.field[None, channels],
            torch.stack((x, y), -1)[None] / self.extent,
            padding_mode="border",
            align_corners=True,
        )[0]

    def above(self, points: Float[Tensor, "3 T R"]) -> Float[Tensor, "T R"]:
        """Return the height of each point above the ground."""
        x, y, z = points
        return z - self.sample(x, y, slice(0, 1))[0]

    def normals(self, points: Points) -> Points:
        """Return the unit normals of the ground below each point, smooth across samples."""
        slopes = self.sample(points[0, None], points[1, None], slice(1, 3))[:, 0]
        upward = torch.cat((-slopes, torch.ones_like(slopes[:1])))
        return upward * (upward * upward).sum(0).rsqrt()

    def hit(self, origins: Origins, directions: Points, max_t: PerRay, refine_steps: int) -> PerRay:
        """Return the t at which each ray first goes under the ground, before `max_t`.

        The step that crosses it is narrowed by false position (Illinois), `refine_steps` times.
        """
        progress = torch.linspace(0, 1, MARCH_STEPS, device=max_t.device)[:, None]
        t = MIN_GROUND_T * (max_t / MIN_GROUND_T) ** progress
        above = self.above(origins[:, None] + t * directions[:, None])
        # The largest countdown among the steps under the ground belongs to the first of them.
        countdown = torch.arange(MARCH_STEPS, 0, -1.0, device=max_t.device)[:, None]
        latest = torch.where(above < 0, countdown, 0).amax(0, keepdim=True).long()
        crossed = latest[0] > 0
        after = (MARCH_STEPS - latest).clamp(1, MARCH_STEPS - 1)
        before = after - 1
        low, high = t.gather(0, before), t.gather(0, after)
        gap_low, gap_high = above.gather(0, before), above.gather(0, after)
        for _ in range(refine_steps):
            middle = low + (high - low) * gap_low / (gap_low - gap_high).clamp(min=TINY)
            gap = self.above(origins[:, None] + middle * directions[:, None])
            over = gap > 0
            low, high = torch.where(over, middle, low), torch.where(over, high, middle)
            # Halving the gap of the unchanged side makes the next guess fall beyond the root.
            gap_low = torch.where(over, gap, gap_low / 2)
            gap_high = torch.where(over, gap_high / 2, gap)
        return torch.where(crossed, middle[0], torch.inf)
