"""The values that data, models and rendering exchange: Cameras, Views and Gaussians.

Constructors check shapes; `validate()` also checks the numbers (finite, in range, rotations
orthonormal) and is called once, where data enters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from operator import itemgetter
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from asysplat.errors import InputError

ORTHONORMAL_TOLERANCE = 1e-3
MAX_FIELD_OF_VIEW = 20  # image side over focal length: 169 degrees
MAPS = ("depths", "masks", "alphas", "disparities")  # optional fields of `Views`
UNKNOWN = {"masks": True, "alphas": 1.0}  # where a field is unknown; depths are 0

Record = TypeVar("Record", bound="TensorRecord")


@dataclass(frozen=True)
class TensorRecord:
    """A frozen dataclass of tensors, and of other such records, that moves and stacks as one."""

    def map(self: Record, function: Callable[[Tensor], Tensor]) -> Record:
        """Apply `function` to every tensor; None and plain numbers stay as they are."""
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changed[field.name] = function(value)
            elif isinstance(value, TensorRecord):
                changed[field.name] = value.map(function)
        return replace(self, **changed)

    def to(self: Record, *args, **kwargs) -> Record:
        """Apply `Tensor.to` to every tensor."""
        return self.map(lambda tensor: tensor.to(*args, **kwargs))

    @classmethod
    def stack(cls: type[Record], records: Sequence[Record]) -> Record:
        """Stack records of equal shapes along a new first dimension."""
        stacked = {}
        for field in fields(cls):
            values = [getattr(record, field.name) for record in records]
            if isinstance(values[0], TensorRecord):
                stacked[field.name] = type(values[0]).stack(values)
            elif all(isinstance(value, Tensor) for value in values):
                stacked[field.name] = torch.stack(values)
            elif any(value is None for value in values):
                # The batch lacks a field that any scene lacks.
                stacked[field.name] = None
            elif all(value == values[0] for value in values):
                stacked[field.name] = values[0]
            else:
                raise InputError(
                    f"{cls.__name__}.{field.name} differs within one batch ({values}): "
                    "give all scenes of a batch the same size."
                )
        return cls(**stacked)


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Pinhole cameras, OpenCV axes: x right, y down, z forward.

    The center of the top left pixel is (0.5, 0.5).

    Args:
        intrinsics: [..., V, 3, 3] in pixels.
        cam_to_world: [..., V, 4, 4] rigid transforms, in scene units.
        height, width: image size in pixels, shared by all views.

    Example:
        >>> import torch
        >>> from asysplat import Cameras
        >>> intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
        >>> cameras = Cameras(intrinsics[None], torch.eye(4)[None], height=48, width=64)
        >>> origins, directions = cameras.rays()
        >>> directions.shape
        torch.Size([1, 48, 64, 3])
    """

    intrinsics: Float[Tensor, "*batch V 3 3"]
    cam_to_world: Float[Tensor, "*batch V 4 4"]
    height: int
    width: int

    def __post_init__(self):
        _check_shape("Cameras.intrinsics", self.intrinsics, (3, 3))
        _check_shape("Cameras.cam_to_world", self.cam_to_world, (4, 4))
        if self.intrinsics.shape[:-2] != self.cam_to_world.shape[:-2]:
            raise InputError(
                f"Cameras.intrinsics has shape {tuple(self.intrinsics.shape)} and cam_to_world "
                f"{tuple(self.cam_to_world.shape)}: give one 3x3 and one 4x4 matrix a view."
            )
        if self.height < 1 or self.width < 1:
            raise InputError(
                f"Cameras.height and width are {self.height} and {self.width}: "
                "an image needs at least one pixel."
            )

    @property
    def num_views(self) -> int:
        return self.intrinsics.shape[-3]

    @property
    def centers(self) -> Float[Tensor, "*batch V 3"]:
        return self.cam_to_world[..., :3, 3]

    def select(self, views: Sequence[int] | Tensor) -> "Cameras":
        """Return the views with these indices, in the given order."""
        index = torch.as_tensor(views, device=self.intrinsics.device)
        return replace(
            self,
            intrinsics=self.intrinsics.index_select(-3, index),
            cam_to_world=self.cam_to_world.index_select(-3, index),
        )

    def join(self, others: "Cameras") -> "Cameras":
        """Return these cameras and then others of the same size."""
        intrinsics = torch.cat((self.intrinsics, others.intrinsics), dim=-3)
        poses = torch.cat((self.cam_to_world, others.cam_to_world), dim=-3)
        return replace(self, intrinsics=intrinsics, cam_to_world=poses)

    def resized(self, height: int, width: int) -> "Cameras":
        """Return cameras of `height` x `width` pixels with the same field of view."""
        factors = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(
            self, intrinsics=factors[:, None] * self.intrinsics, height=height, width=width
        )

    def pixel_directions(self) -> Float[Tensor, "*batch V H W 3"]:
        """Compute the camera-space directions through every pixel center, with z = 1."""
        dtype, device = self.intrinsics.dtype, self.intrinsics.device
        y, x = torch.meshgrid(
            torch.arange(self.height, dtype=dtype, device=device) + 0.5,
            torch.arange(self.width, dtype=dtype, device=device) + 0.5,
            indexing="ij",
        )
        fx, fy = self.intrinsics[..., 0, 0, None, None], self.intrinsics[..., 1, 1, None, None]
        cx, cy = self.intrinsics[..., 0, 2, None, None], self.intrinsics[..., 1, 2, None, None]
        x, y, z = torch.broadcast_tensors((x - cx) / fx, (y - cy) / fy, torch.ones_like(x))
        return torch.stack((x, y, z), dim=-1)

    def rays(self) -> tuple[Float[Tensor, "*batch V H W 3"], Float[Tensor, "*batch V H W 3"]]:
        """Compute the world-space origin and unit direction of every pixel center's ray."""
        # Not a matrix product, which autocast would round to half precision.
        rotation = self.cam_to_world[..., None, None, :3, :3]
        directions = (rotation * self.pixel_directions()[..., None, :]).sum(-1)
        directions = torch.nn.functional.normalize(directions, dim=-1)
        return self.centers[..., None, None, :].expand_as(directions), directions

    def project(
        self, points: Float[Tensor, "*batch N 3"]
    ) -> tuple[
        Float[Tensor, "*batch V N 2"], Float[Tensor, "*batch V N"], Bool[Tensor, "*batch V N"]
    ]:
        """Project world points into every view.

        Returns:
            Positions (x, y) in pixels; depths along the camera's z axis; whether a point is in
            front of the camera and inside the image.
        """
        # The offset comes first: it is exact for scenes far from the origin.
        offsets = points[..., None, :, :] - self.centers[..., None, :]
        local = offsets @ self.cam_to_world[..., :3, :3]
        depth = local[..., 2]
        pixels = (local @ self.intrinsics.mT)[..., :2] / depth.clamp_min(1e-12)[..., None]
        size = pixels.new_tensor([self.width, self.height])
        return pixels, depth, (depth > 0) & ((pixels >= 0) & (pixels < size)).all(-1)

    def distances(self, others: "Cameras") -> Float[Tensor, "*batch V W"]:
        """Compute how far other cameras are: distance / extent + angle / pi.

        The distance is between the centers, the extent the largest between two of the others, and
        the angle between the viewing directions, which alone counts if they share one center.
        """
        apart = (self.centers[..., :, None, :] - others.centers[..., None, :, :]).norm(dim=-1)
        among = (others.centers[..., :, None, :] - others.centers[..., None, :, :]).norm(dim=-1)
        extent = among.amax((-2, -1), keepdim=True)
        cosine = self.cam_to_world[..., :3, 2] @ others.cam_to_world[..., :3, 2].mT
        angle = cosine.clamp(-1, 1).acos()
        return apart / extent.where(extent > 0, torch.inf) + angle / torch.pi

    def validate(self, name: str = "Cameras") -> "Cameras":
        """Return self if all numbers are usable.

        Raises:
            InputError: NaN or infinity, a focal length <= 0 or not in pixels, a rotation that is
                not orthonormal, or a last row other than 0 0 0 1; it names the field and the view.
        """
        _check_finite(f"{name}.intrinsics", self.intrinsics, 2)
        _check_finite(f"{name}.cam_to_world", self.cam_to_world, 2)
        focal = torch.stack((self.intrinsics[..., 0, 0], self.intrinsics[..., 1, 1]), -1)
        _check_all(
            f"{name}.intrinsics",
            (focal > 0).all(-1),
            "has a focal length <= 0: give fx and fy in pixels, both positive",
        )
        _check_all(
            f"{name}.intrinsics",
            (MAX_FIELD_OF_VIEW * focal > focal.new_tensor([self.width, self.height])).all(-1),
            f"has a focal length below 1/{MAX_FIELD_OF_VIEW} of the image: give fx, fy, cx and cy "
            "in pixels; multiply normalized ones by the image's width and height",
        )
        rotation = self.cam_to_world[..., :3, :3]
        identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        # Not a matrix product, which autocast would round to half precision.
        product = (rotation[..., :, None, :] * rotation[..., None, :, :]).sum(-1)
        error = (product - identity).abs().amax((-1, -2))
        proper = (error < ORTHONORMAL_TOLERANCE) & (torch.linalg.det(rotation) > 0)
        _check_all(
            f"{name}.cam_to_world",
            proper,
            "has a rotation that is not orthonormal with determinant +1: remove scale, shear and "
            "mirroring from its upper left 3x3 block",
        )
        last_row = self.cam_to_world.new_tensor([0.0, 0.0, 0.0, 1.0])
        _check_all(
            f"{name}.cam_to_world",
            (self.cam_to_world[..., 3, :] - last_row).abs().amax(-1) < ORTHONORMAL_TOLERANCE,
            "has a last row other than 0 0 0 1: give camera-to-world, row-major",
        )
        return self


@dataclass(frozen=True)
class Views(TensorRecord):
    """Posed photographs.

    Args:
        cameras: V cameras.
        images: [..., V, 3, H, W] RGB in [0, 1], or as files store it: uint8 in 0..255, a fourth of
            the memory.
        depths: [..., V, H, W] along the camera's z axis, in scene units; 0 if unknown.
        masks: [..., V, H, W], True where a pixel counts.
        alphas: [..., V, H, W] opacity of the photographed object in [0, 1]: 0 where a pixel shows
            the background alone.
        disparities: [..., V, H, W] estimated inverse depths, up to a scale and a shift of each
            view; 0 if unknown.

    Example:
        >>> import torch
        >>> from asysplat import Cameras, Views
        >>> intrinsics = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]).repeat(2, 1, 1)
        >>> cameras = Cameras(intrinsics, torch.eye(4).repeat(2, 1, 1), height=48, width=64)
        >>> views = Views(cameras, torch.rand(2, 3, 48, 64)).validate()
        >>> views.select([1]).num_views
        1
    """

    cameras: Cameras
    images: Float[Tensor, "*batch V 3 H W"] | UInt8[Tensor, "*batch V 3 H W"]
    depths: Float[Tensor, "*batch V H W"] | None = None
    masks: Bool[Tensor, "*batch V H W"] | None = None
    alphas: Float[Tensor, "*batch V H W"] | None = None
    disparities: Float[Tensor, "*batch V H W"] | None = None

    def __post_init__(self):
        if not isinstance(self.cameras, Cameras):
            raise InputError(
                f"Views.cameras is a {type(self.cameras).__name__}: give Views(cameras, images)."
            )
        batch = self.cameras.intrinsics.shape[:-2]
        size = (self.cameras.height, self.cameras.width)
        if getattr(self.images, "dtype", None) != torch.uint8:
            _check_float("Views.images (RGB in [0, 1])", self.images)
        _check_exact("Views.images", self.images, (*batch, 3, *size))
        for name in MAPS:
            if getattr(self, name) is not None:
                _check_exact(f"Views.{name}", getattr(self, name), (*batch, *size))

    @property
    def num_views(self) -> int:
        return self.cameras.num_views

    def select(self, views: Sequence[int] | Tensor) -> "Views":
        """Return the views with these indices, in the given order."""
        index = torch.as_tensor(views, device=self.images.device)
        maps = {name: getattr(self, name) for name in MAPS}
        selected = {n: m.index_select(-3, index) for n, m in maps.items() if m is not None}
        images = self.images.index_select(-4, index)
        return replace(self, cameras=self.cameras.select(index), images=images, **selected)

    def join(self, others: "Views") -> "Views":
        """Return these views and then others of the same size, their images stored as these are.

        A field that only one part has is unknown of the other: masked in, opaque, depth 0.
        """
        sizes = [(part.cameras.height, part.cameras.width) for part in (self, others)]
        if sizes[0] != sizes[1]:
            raise InputError(
                f"Views.join got {sizes[0]} and {sizes[1]} pixels: give both one size."
            )
        parts, maps = (self, others), {}
        for name in MAPS:
            known = [getattr(part, name) for part in parts]
            like = next((values for values in known if values is not None), None)
            if like is not None:
                maps[name] = torch.cat(
                    [
                        like.new_full(part.images[..., 0, :, :].shape, UNKNOWN.get(name, 0))
                        if values is None
                        else values
                        for part, values in zip(parts, known, strict=True)
                    ],
                    dim=-3,
                )
        stored = encode(decode(others.images), self.images.dtype)
        images = torch.cat((self.images, stored), dim=-4)
        return Views(self.cameras.join(others.cameras), images, **maps)

    @property
    def known_depths(self) -> Float[Tensor, "*batch V H W"] | None:
        """The depths, 0 where they are unknown or a mask excludes the pixel."""
        if self.depths is None or self.masks is None:
            return self.depths
        return self.depths.where(self.masks, 0)

    def nearest_images(self, cameras: Cameras) -> Tensor:
        """Return [..., W, 3, H, W], for each of the cameras the image of the nearest view."""
        nearest = cameras.distances(self.cameras).argmin(-1)
        return decode(self.images.take_along_dim(nearest[..., None, None, None], dim=-4))

    def one(self, view: int) -> "Views":
        """Return one of [V] views, [1], decoded; a slice copies nothing and waits for no GPU."""
        return self.map(itemgetter(slice(view, view + 1))).decoded()

    def decoded(self) -> "Views":
        """Return views whose images are in [0, 1]."""
        return replace(self, images=decode(self.images))

    def with_images(self, change: Callable[[int, "Views"], Tensor]) -> "Views":
        """Return [V] views with other images, stored as before.

        `change` computes that of a view, [1, 3, H, W] in [0, 1], from its index and the view, [1].
        """
        images = torch.empty_like(self.images)
        for view in range(self.num_views):
            images[view] = encode(change(view, self.one(view)), images.dtype)[0]
        return replace(self, images=images)

    def resized(self, height: int, width: int) -> "Views":
        """Return views of another size, with the same field of view.

        Images and alphas are means over areas. A pixel is masked in only where all pixels it covers
        are; a depth or disparity is that of the nearest pixel.
        """
        size = (height, width)
        area, nearest = (
            partial(F.interpolate, size=size, mode=mode) for mode in ("area", "nearest")
        )

        methods: dict[str, Callable[[Tensor], Tensor]] = {
            "images": lambda images: torch.cat(
                [encode(area(decode(part)), images.dtype) for part in images.split(3)]
            ),
            "alphas": area,
            "masks": lambda masks: whole_pixels(masks, size),
            "depths": nearest,
            "disparities": nearest,
        }
        resized = {}
        for name, method in methods.items():
            values = getattr(self, name)
            if values is not None:
                maps = method(values.reshape(-1, 1, *values.shape[-2:]))
                resized[name] = maps.reshape(*values.shape[:-2], *size)
        return replace(self, cameras=self.cameras.resized(*size), **resized)

    def mean_color(self) -> Float[Tensor, "*batch 3"]:
        """Compute the mean color of all pixels that are masked in; gray if there are none."""
        if self.images.dtype == torch.uint8:  # [V], one by one
            sums = [self.one(view)._color_sums() for view in range(self.num_views)]
            total, count = (torch.stack(parts).sum(0) for parts in zip(*sums, strict=True))
        elif self.masks is None:
            return self.images.movedim(-3, -1).flatten(-4, -2).mean(-2)
        else:
            total, count = self._color_sums()
        return (total / count).nan_to_num(0.5)

    def _color_sums(self) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 1"]]:
        colors = self.images.movedim(-3, -1)
        weights = torch.ones_like(colors[..., :1])
        if self.masks is not None:
            weights = self.masks[..., None].to(colors)
        total, count = (values.flatten(-4, -2).sum(-2) for values in (colors * weights, weights))
        return total, count

    def color_behind(self, default: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Compute the mean color of the pixels that show the background alone; else `default`."""
        if self.alphas is None:
            return default
        behind = self.alphas == 0
        if self.masks is not None:
            behind &= self.masks
        shown = behind.flatten(-3).any(-1, keepdim=True)
        return replace(self, masks=behind).mean_color().where(shown, default)

    def masked(self, rendered: Float[Tensor, "*batch V 3 H W"]) -> Float[Tensor, "*batch V 3 H W"]:
        """Copy the photographs into masked pixels, where they add no error or gradient."""
        if self.masks is None:
            return rendered
        return torch.where(self.masks[..., None, :, :], rendered, decode(self.images))

    def without(self, pixels: Bool[Tensor, "*batch V H W"]) -> "Views":
        """Mask out pixels, too."""
        masks = ~pixels if self.masks is None else self.masks & ~pixels
        return replace(self, masks=masks)

    def over(self, before: Tensor, color: Tensor) -> "Views":
        """Change the color, RGB, that transparent pixels show; opaque ones stay."""
        if self.alphas is None:
            return self
        if self.images.dtype == torch.uint8:
            return self.with_images(lambda _, view: view.over(before, color).images)
        change = (1 - self.alphas)[..., None, :, :] * (color - before)[:, None, None]
        return replace(self, images=(self.images + change).clamp(0, 1))

    def surfaces(self, size: tuple[int, int]) -> Bool[Tensor, "*batch V h w"] | None:
        """Return where pixels of another size show a surface; None: everywhere.

        All that such a pixel covers is masked in, and most of it is no background.
        """
        shown = None if self.masks is None else whole_pixels(self.masks, size)
        if self.alphas is None:
            return shown
        opaque = F.interpolate(self.alphas, size, mode="area") > 0.5
        return opaque if shown is None else shown & opaque

    def validate(self, name: str = "Views") -> "Views":
        """Return self if all numbers are usable.

        Raises:
            InputError: as for `Cameras.validate`; also images outside [0, 1] or depths below 0.
        """
        self.cameras.validate(f"{name}.cameras")
        floats = self.images.dtype != torch.uint8 and self.images.numel() > 0
        if floats and not all(0 <= end.item() <= 1 for end in self.images.aminmax()):
            _check_finite(f"{name}.images", self.images, 3)
            _check_all(
                f"{name}.images",
                ((self.images >= 0) & (self.images <= 1)).all(-1).all(-1).all(-1),
                "has values outside [0, 1]: divide 8-bit images by 255",
            )
        distances = "distances along the camera's z axis"
        units = {"depths": distances, "disparities": "inverse depths"}
        for field, unit in units.items():
            values = getattr(self, field)
            if values is not None:
                _check_finite(f"{name}.{field}", values, 2)
                _check_all(
                    f"{name}.{field}",
                    (values >= 0).all(-1).all(-1),
                    f"has negative values: give {unit}, 0 if unknown",
                )
        return self


def decode(images: Tensor) -> Tensor:
    """Return images, uint8 or decoded ones, in [0, 1]."""
    return images.float().div_(255) if images.dtype == torch.uint8 else images


def encode(images: Tensor, dtype: torch.dtype) -> Tensor:
    """Return images in [0, 1] as they are stored: rounded for uint8, else as they are."""
    return (images * 255).round_().byte() if dtype == torch.uint8 else images


def whole_pixels(masks: Bool[Tensor, "B V H W"], size: tuple[int, int]) -> Bool[Tensor, "B V h w"]:
    """Return masks of another size: True where all pixels that a pixel covers are."""
    return F.interpolate(masks.float(), size, mode="area") == 1


def inverse_depths(depths: Float[Tensor, "*views H W"]) -> Float[Tensor, "*views H W"]:
    """Compute 1 / depth; 0, as at infinity, for an unknown depth."""
    return torch.where(depths > 0, 1 / depths.where(depths > 0, 1), 0)


@dataclass(frozen=True)
class Gaussians(TensorRecord):
    """3D Gaussians, ready to render: all activations are applied.

    Args:
        means: [..., N, 3] in scene units.
        quats: [..., N, 4] rotations, wxyz; the renderer normalizes them.
        scales: [..., N, 3] standard deviations > 0, in scene units.
        opacities: [..., N] in (0, 1).
        sh: [..., N, K, 3] spherical harmonics, K = 1, 4, 9 or 16; color = 0.5 + sum_k sh_k Y_k.

    Example:
        >>> import torch
        >>> from asysplat import Gaussians
        >>> gaussians = Gaussians(
        ...     means=torch.tensor([[0.0, 0, 4], [1, 0, 4]]),
        ...     quats=torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0]]),
        ...     scales=torch.full((2, 3), 0.1),
        ...     opacities=torch.tensor([0.5, 0.9]),
        ...     sh=torch.ones(2, 1, 3),
        ... ).validate()
        >>> gaussians.num_gaussians
        2
    """

    means: Float[Tensor, "*batch N 3"]
    quats: Float[Tensor, "*batch N 4"]
    scales: Float[Tensor, "*batch N 3"]
    opacities: Float[Tensor, "*batch N"]
    sh: Float[Tensor, "*batch N K 3"]

    def __post_init__(self):
        batch = self.opacities.shape
        _check_exact("Gaussians.means", self.means, (*batch, 3))
        _check_exact("Gaussians.quats", self.quats, (*batch, 4))
        _check_exact("Gaussians.scales", self.scales, (*batch, 3))
        if self.sh.shape[-2] not in (1, 4, 9, 16):
            raise InputError(
                f"Gaussians.sh has {self.sh.shape[-2]} coefficients: "
                "give 1, 4, 9 or 16 (degree 0 to 3)."
            )
        _check_exact("Gaussians.sh", self.sh, (*batch, self.sh.shape[-2], 3))

    @property
    def num_gaussians(self) -> int:
        return self.opacities.shape[-1]

    def scale_by(self, factor: float) -> "Gaussians":
        """Scale means and sizes: the same scene in units that are `factor` times smaller."""
        return replace(self, means=self.means * factor, scales=self.scales * factor)

    def join(self, others: "Gaussians") -> "Gaussians":
        """Return these Gaussians, [N], and then others with as many coefficients."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return Gaussians(*map(torch.cat, pairs))

    def keep(self, mask: Bool[Tensor, "N"]) -> "Gaussians":
        """Return the Gaussians where `mask` is True; for one scene, without batch dimensions."""
        return self.map(lambda tensor: tensor[mask])

    def validate(self, name: str = "Gaussians") -> "Gaussians":
        """Return self if all numbers can be rendered.

        Raises:
            InputError: NaN or infinity, a scale <= 0, an opacity outside (0, 1].
        """
        for field in fields(self):
            tensor = getattr(self, field.name)
            _check_finite(f"{name}.{field.name}", tensor, tensor.ndim - self.opacities.ndim)
        _check_all(f"{name}.scales", (self.scales > 0).all(-1), "is <= 0: apply exp to log-scales")
        _check_all(
            f"{name}.opacities",
            (self.opacities > 0) & (self.opacities <= 1),
            "lies outside (0, 1]: apply the sigmoid to logits",
        )
        return self


def _check_float(name: str, tensor: Tensor) -> None:
    if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
        actual = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
        raise InputError(f"{name} is {actual}: give a torch tensor of floating-point numbers.")


def _check_shape(name: str, tensor: Tensor, last: tuple[int, ...]) -> None:
    _check_float(name, tensor)
    if tensor.ndim <= len(last) or tuple(tensor.shape[-len(last) :]) != last:
        expected = ", ".join(map(str, last))
        raise InputError(f"{name} has shape {tuple(tensor.shape)}: expected [..., V, {expected}].")


def _check_exact(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(tensor.shape) != tuple(shape):
        raise InputError(f"{name} has shape {tuple(tensor.shape)}: expected {tuple(shape)}.")


def _check_all(name: str, good: Tensor, complaint: str) -> None:
    """Raise InputError with the index of the first False of `good`."""
    if not bool(good.all()):
        index = tuple(torch.nonzero(~good)[0].tolist())
        raise InputError(f"{name}[{', '.join(map(str, index))}] {complaint}.")


def _check_finite(name: str, tensor: Tensor, item_dims: int) -> None:
    good = tensor.isfinite()
    for _ in range(item_dims):
        good = good.all(-1)
    _check_all(name, good, "holds NaN or infinity: repair or remove that entry")
