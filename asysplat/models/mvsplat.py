"""MVSplat (Chen et al. 2024; donydchen/mvsplat): depth from a cost volume of learned features.

A baseline of the paper's Table 5. The layers and sizes are the published ones, written anew; it
starts from random weights, where the published one starts from UniMatch's. Differences: colors have
SH of degree 3, not 4, and in the world's axes; the depth range is that of normalized scenes.
"""

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from asysplat.kernels.dispatch import without_autocast
from asysplat.models.network import Network
from asysplat.models.single_branch import refuse_ratio
from asysplat.scene import Cameras, Gaussians, Views

STRIDE = 4  # pixels along a side of a feature
WINDOWS = 2  # attention windows along a side of the feature maps
TRANSFORMER_LAYERS = 6
LEVELS, REFINE_LEVELS = 3, 5  # levels of the U-Nets over features and over pixels
SCALE_RANGE = (0.5, 15.0)  # scales of Gaussians, in tenths of the sum of a pixel's sides
MAX_SH_DEGREE = 3


class MVSplat(Network):
    """A Gaussian for each pixel, at depths of a plane-sweep volume through which gradients flow.

    Args:
        width: factor of all channels.
        geometry_ratio, parameter_budget: must be None and 1: there is one branch.
        channels, refine_channels: channels of the features, and of the U-Net over pixels.
        planes: number of inverse depths of the volume, equally spaced.
        near, far: least and greatest depth, in units of the normalized scene.
    """

    view_counts = (2, 8)
    inverse: Float[Tensor, "planes"]

    def __init__(
        self,
        width: float = 1.0,
        geometry_ratio: float | None = None,
        parameter_budget: float = 1.0,
        channels: int = 128,
        refine_channels: int = 32,
        planes: int = 128,
        near: float = 0.5,
        far: float = 100.0,
        sh_degree: int = MAX_SH_DEGREE,
    ):
        super().__init__(patch=16)
        refuse_ratio(geometry_ratio, parameter_budget)
        channels, refine = (max(8, round(c * width / 8) * 8) for c in (channels, refine_channels))
        self.register_buffer("inverse", torch.linspace(1 / far, 1 / near, planes), persistent=False)
        self.bands = (sh_degree + 1) ** 2
        self.splits = (2, 3, 4, 3 * self.bands)  # offset in the pixel, scales, quaternion, SH
        outputs = sum(self.splits)
        self.features = FeatureEncoder(channels)
        self.transformer = nn.ModuleList(
            CrossViewLayer(channels, shifted=bool(layer % 2)) for layer in range(TRANSFORMER_LAYERS)
        )
        self.volume_in = nn.Sequential(conv(planes + channels, channels), norm(channels), nn.GELU())
        self.volume_net = UNet(channels, LEVELS)
        self.volume_out = conv(channels, planes)
        self.volume_skip = nn.Conv2d(planes + channels, planes, 1)
        self.planes_head = two_convs(planes, 2 * planes, planes)
        self.upsample_in = conv(2 * channels, channels)
        self.project = conv(channels, refine)
        self.refine_in = nn.Sequential(conv(3 + refine + 2, refine), norm(refine), nn.GELU())
        self.refine = UNet(refine, REFINE_LEVELS)
        self.depth_head = two_convs(refine, 2 * refine, 2)  # change of inverse depth, opacity
        self.gaussian_head = two_convs(refine + 3 + channels, 2 * outputs, outputs)

    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, V H W] from views [B, V]."""
        batch, cameras, images = views.images.shape[:2], views.cameras, flat(views.images)

        def maps(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "B V c h w"]:
            return x.unflatten(0, batch)

        local = maps(self.features(images * 2 - 1))
        features = rearrange(local, "b v c h w -> b v h w c")
        features = features + window_positions(features)
        for layer in self.transformer:
            features = layer(features)
        features = rearrange(features, "b v h w c -> b v c h w")
        costs = cost_volume(features, cameras.resized(*features.shape[-2:]), self.inverse)
        volume = flat(torch.cat((costs, features), dim=2))
        refined = flat(self.volume_net(maps(self.volume_in(volume))))
        likelihood = self.volume_out(refined) + self.volume_skip(volume)
        likelihood = self.planes_head(likelihood).softmax(1)
        inverse = upsample(torch.einsum("ndhw,d->nhw", likelihood, self.inverse)[:, None])
        confidence = F.interpolate(likelihood.amax(1, keepdim=True), scale_factor=STRIDE)
        colors = flat(torch.cat((features, local), dim=2))
        colors = F.gelu(upsample(self.upsample_in(colors)))
        fine = torch.cat((images, self.project(colors), inverse, confidence), dim=1)
        fine = flat(self.refine(maps(self.refine_in(fine))))
        change, opacity = self.depth_head(fine).split(1, dim=1)
        inverse = (inverse + change).clamp(self.inverse[0], self.inverse[-1])
        raw = self.gaussian_head(torch.cat((fine, images, colors), dim=1))
        decoded = (
            rearrange(maps(x).to(images), "b v c h w -> b v h w c")
            for x in (1 / inverse, opacity.sigmoid(), raw)
        )
        return self.decode(*decoded, cameras).map(lambda field: field.flatten(1, 3))

    def decode(
        self,
        depth: Float[Tensor, "B V H W 1"],
        opacities: Float[Tensor, "B V H W 1"],
        raw: Float[Tensor, "B V H W c"],
        cameras: Cameras,
    ) -> Gaussians:
        """Place Gaussians in the world; their shapes turn with the cameras."""
        offset, scales, quats, sh = raw.split(self.splits, dim=-1)
        focal = torch.stack((cameras.intrinsics[..., 0, 0], cameras.intrinsics[..., 1, 1]), dim=-1)
        pixel = 1 / focal[:, :, None, None]  # sides at depth 1
        shift = F.pad((offset.sigmoid() - 0.5) * pixel, (0, 1))
        points = depth * (cameras.pixel_directions() + shift)
        rotations = cameras.cam_to_world[:, :, None, None, :3, :3]
        least, largest = SCALE_RANGE
        sizes = (least + (largest - least) * scales.sigmoid()) * 0.1 * pixel.sum(-1, keepdim=True)
        # As published: higher bands start near 0.
        degrees = torch.arange(self.bands, device=sh.device).sqrt().floor()
        weights = torch.where(degrees > 0, 0.1 * 0.25**degrees, 1.0)[:, None]
        return Gaussians(
            means=(rotations * points[..., None, :]).sum(-1) + cameras.centers[:, :, None, None],
            quats=multiply(quaternions(rotations), quats),
            scales=sizes * depth,
            opacities=opacities[..., 0],
            sh=sh.unflatten(-1, (-1, 3)) * weights,
        )


class FeatureEncoder(nn.Sequential):
    """Residual convolutions from images to features at a quarter of the resolution."""

    def __init__(self, channels: int):
        dims = (channels // 2, 3 * channels // 4, channels)
        blocks, previous = [], dims[0]
        for dim, stride in zip(dims, (1, 2, 1), strict=True):
            blocks += [ResidualBlock(previous, dim, stride), ResidualBlock(dim, dim)]
            previous = dim
        start = nn.Conv2d(3, dims[0], 7, stride=2, padding=3, bias=False)
        super().__init__(
            *(start, nn.InstanceNorm2d(dims[0]), nn.ReLU()),
            *blocks,
            nn.Conv2d(channels, channels, 1),
        )


class ResidualBlock(nn.Module):
    """ReLU(skip(x) + two of [Conv 3x3, InstanceNorm, ReLU])."""

    def __init__(self, width: int, new_width: int, stride: int = 1):
        super().__init__()
        layers = []
        for before, step in ((width, stride), (new_width, 1)):
            layers += [nn.Conv2d(before, new_width, 3, step, 1, bias=False)]
            layers += [nn.InstanceNorm2d(new_width), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.skip = nn.Identity()
        if stride > 1 or width != new_width:
            project = nn.Conv2d(width, new_width, 1, stride)
            self.skip = nn.Sequential(project, nn.InstanceNorm2d(new_width))

    def forward(self, x: Float[Tensor, "n c H W"]) -> Float[Tensor, "n d h w"]:
        return F.relu(self.skip(x) + self.layers(x))


class CrossViewLayer(nn.Module):
    """Attention within each window of a view, then to the same window of all other views."""

    def __init__(self, width: int, shifted: bool):
        super().__init__()
        self.shifted = shifted
        self.within, self.across = WindowAttention(width), WindowAttention(width)
        self.mlp = nn.Sequential(
            nn.Linear(2 * width, 8 * width, bias=False),
            nn.GELU(),
            nn.Linear(8 * width, width, bias=False),
            nn.LayerNorm(width),
        )

    def forward(self, x: Float[Tensor, "B V h w c"]) -> Float[Tensor, "B V h w c"]:
        _, count, height, width, _ = x.shape
        # By half of a window, as in Swin.
        shift = [side // WINDOWS // 2 if self.shifted else 0 for side in (height, width)]
        back = [-s for s in shift]
        visible = same_region((height, width), shift, x.device)
        x = torch.roll(x, back, (2, 3))
        tokens = windows(x)
        tokens = tokens + self.within(tokens, tokens, visible)
        other_views = (torch.arange(count)[:, None] + torch.arange(1, count)) % count
        context = rearrange(tokens[:, other_views], "b v k n l c -> b v n (k l) c")
        message = self.across(tokens, context, visible.repeat(1, 1, count - 1))
        tokens = tokens + self.mlp(torch.cat((tokens, message), dim=-1))
        size = {"p": WINDOWS, "i": height // WINDOWS}
        x = rearrange(tokens, "b v (p q) (i j) c -> b v (p i) (q j) c", **size)
        return torch.roll(x, shift, (2, 3))


class WindowAttention(nn.Module):
    """LN(o(attn(q(x), kv(context)))), with one head."""

    def __init__(self, width: int):
        super().__init__()
        self.query, self.key, self.value, self.out = (
            nn.Linear(width, width, bias=False) for _ in range(4)
        )
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        x: Float[Tensor, "B V n l c"],
        context: Float[Tensor, "B V n m c"],
        visible: Bool[Tensor, "n l m"],
    ) -> Float[Tensor, "B V n l c"]:
        q, k, v = self.query(x), self.key(context), self.value(context)
        return self.norm(self.out(F.scaled_dot_product_attention(q, k, v, visible)))


def windows(x: Shaped[Tensor, "B V h w c"]) -> Shaped[Tensor, "B V n l c"]:
    """Divide maps into WINDOWS x WINDOWS windows."""
    return rearrange(x, "b v (p i) (q j) c -> b v (p q) (i j) c", p=WINDOWS, q=WINDOWS)


def same_region(
    size: tuple[int, int], shift: list[int], device: torch.device
) -> Bool[Tensor, "n l l"]:
    """Return which pixels of a window were in one piece before a shift around the border."""
    rows, columns = (
        torch.arange(s, device=device) >= s - k for s, k in zip(size, shift, strict=True)
    )
    region = 2 * rows[:, None] + 1 * columns
    region = windows(region[None, None, :, :, None])[0, 0, ..., 0]
    return region[:, :, None] == region[:, None]


def window_positions(x: Float[Tensor, "B V h w c"]) -> Float[Tensor, "h w c"]:
    """Return sines and cosines of a pixel's place in its window (DETR's)."""
    height, width, channels = x.shape[2:]
    steps = channels // 4
    frequencies = 2 * torch.pi / 10000 ** (torch.arange(steps, device=x.device) / steps)

    def encode(size: int) -> Tensor:
        window = size // WINDOWS
        place = (torch.arange(size, device=x.device) % window + 1) / window
        angles = place[:, None] * frequencies
        return torch.cat((angles.sin(), angles.cos()), dim=-1)

    rows = encode(height)[:, None].expand(-1, width, -1)
    return torch.cat((rows, encode(width).expand(height, -1, -1)), dim=-1).to(x)


def cost_volume(
    features: Float[Tensor, "B V c h w"], cameras: Cameras, inverse: Float[Tensor, "D"]
) -> Float[Tensor, "B V D h w"]:
    """Compute how well features match those of the other views at each inverse depth.

    The mean over the other views of the product of features, over sqrt(c); 0 outside of a view.
    """
    B, V, c, h, w = features.shape
    with without_autocast(features):
        features = features.to(cameras.intrinsics)
        poses = cameras.cam_to_world
        reference = flat(features)
        directions = cameras.pixel_directions()
        size = features.new_tensor([2 / w, 2 / h])
        total = torch.zeros(B * V, len(inverse), h, w).to(features)
        for step in range(1, V):
            other_views = torch.roll(torch.arange(V), -step)
            relative = torch.linalg.inv(poses[:, other_views]) @ poses
            rays = torch.einsum("bvxy,bvhwy->bvhwx", relative[..., :3, :3], directions)
            moves = inverse[:, None, None, None] * relative[..., None, None, None, :3, 3]
            points = rays[:, :, None] + moves  # times the inverse depth
            points = torch.einsum("bvxy,bvdhwy->bvdhwx", cameras.intrinsics[:, other_views], points)
            grid = points[..., :2] / points[..., 2:].clamp_min(1e-6) * size - 1
            grid = torch.where(points[..., 2:] > 1e-6, grid, 2.0).flatten(0, 1).flatten(1, 2)
            warped = F.grid_sample(flat(features[:, other_views]), grid, align_corners=False)
            total = total + (reference[:, :, None] * warped.unflatten(2, (-1, h))).sum(1)
        return (total / ((V - 1) * c**0.5)).unflatten(0, (B, V))


class UNet(nn.Module):
    """A U-Net of equal width at each level, whose coarsest level attends to all views."""

    def __init__(self, width: int, levels: int):
        super().__init__()
        self.start = conv(width, width)
        self.down = nn.ModuleList(NormBlock(width, width) for _ in range(levels))
        self.shrink = nn.ModuleList(
            nn.Conv2d(width, width, 3, stride=2, padding=1) for _ in range(levels - 1)
        )
        self.middle = nn.ModuleList((NormBlock(width, width), NormBlock(width, width)))
        self.up = nn.ModuleList(
            nn.ModuleList(NormBlock(2 * width, width) for _ in range(2)) for _ in range(levels)
        )
        self.grow = nn.ModuleList(conv(width, width) for _ in range(levels - 1))
        self.attention = nn.ModuleList(ViewAttention(width) for _ in range(4))
        self.end = nn.Sequential(norm(width), nn.SiLU(), conv(width, width))

    def forward(self, x: Float[Tensor, "B V c H W"]) -> Float[Tensor, "B V c H W"]:
        views = x.shape[1]
        x = self.start(flat(x))
        kept = [x]
        for level, block in enumerate(self.down):
            x = block(x)
            if level == len(self.down) - 1:
                x = self.attention[0](x, views)
            kept.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
                kept.append(x)
        x = self.middle[1](self.attention[1](self.middle[0](x), views))
        for level, blocks in enumerate(self.up):
            for index, block in enumerate(blocks.children()):
                x = block(torch.cat((x, kept.pop()), dim=1))
                if level == 0:
                    x = self.attention[2 + index](x, views)
            if level < len(self.grow):
                x = self.grow[level](F.interpolate(x, scale_factor=2))
        return self.end(x).unflatten(0, (-1, views))


class NormBlock(nn.Module):
    """skip(x) + two of [Conv 3x3, GroupNorm, SiLU]."""

    def __init__(self, width: int, new_width: int):
        super().__init__()
        self.layers = nn.Sequential(
            *(conv(width, new_width), norm(new_width), nn.SiLU()),
            *(conv(new_width, new_width), norm(new_width), nn.SiLU()),
        )
        self.skip = nn.Identity() if width == new_width else nn.Conv2d(width, new_width, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d h w"]:
        return self.skip(x) + self.layers(x)


class ViewAttention(nn.Module):
    """x + o(attn(qkv(x))) over all pixels of all views, in heads of at most 32 channels."""

    def __init__(self, width: int):
        super().__init__()
        self.heads = max(1, width // 32)
        self.qkv, self.out = nn.Conv2d(width, 3 * width, 1), nn.Conv2d(width, width, 1)
        self.norm = norm(width)

    def forward(self, x: Float[Tensor, "n c h w"], views: int) -> Float[Tensor, "n c h w"]:
        height = x.shape[2]
        q, k, v = rearrange(
            self.qkv(x), "(b v) (t p c) h w -> t b p (v h w) c", v=views, t=3, p=self.heads
        )
        read = F.scaled_dot_product_attention(q, k, v)
        read = rearrange(read, "b p (v h w) c -> (b v) (p c) h w", v=views, h=height)
        return x + self.norm(self.out(read))


def conv(width: int, new_width: int) -> nn.Conv2d:
    return nn.Conv2d(width, new_width, 3, padding=1)


def norm(width: int) -> nn.GroupNorm:
    return nn.GroupNorm(8, width)


def two_convs(width: int, hidden: int, new_width: int) -> nn.Sequential:
    return nn.Sequential(conv(width, hidden), nn.GELU(), conv(hidden, new_width))


def flat(x: Tensor) -> Tensor:
    """Join scenes and views to one dimension."""
    return x.flatten(0, 1)


def upsample(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c H W"]:
    """Return maps at the resolution of the images."""
    return F.interpolate(x, scale_factor=STRIDE, mode="bilinear", align_corners=True)


def quaternions(rotations: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Convert rotation matrices to quaternions, wxyz, of any length above 1."""
    x, y, z = rotations.diagonal(dim1=-2, dim2=-1).unbind(-1)
    a, b, c = (rotations[..., i, j] - rotations[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (rotations[..., i, j] + rotations[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    # Each row is a multiple of the quaternion; the longest is the most precise.
    rows = (
        (1 + x + y + z, a, b, c),
        (a, 1 + x - y - z, d, e),
        (b, d, 1 - x + y - z, f),
        (c, e, f, 1 - x - y + z),
    )
    rows = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    longest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    return rows.take_along_dim(longest, dim=-2)[..., 0, :]


def multiply(
    p: Float[Tensor, "*#batch 4"], q: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*#batch 4"]:
    """Compute the products of quaternions: the rotation q, then p."""
    (pw, pv), (qw, qv) = (quaternion.split((1, 3), dim=-1) for quaternion in (p, q))
    scalar = pw * qw - (pv * qv).sum(-1, keepdim=True)
    vector = pw * qv + qw * pv + torch.linalg.cross(*torch.broadcast_tensors(pv, qv))
    return torch.cat((scalar, vector), dim=-1)
