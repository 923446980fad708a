"""The Triton renderer against the reference in float64: on a GPU, or in Triton's interpreter."""

import sys
from collections import Counter

import pytest
import torch
from compiler import DEVICE, INTERPRETED, kernel

from asysplat.errors import InputError
from asysplat.rendering import GSPLAT_1_5, cpu, formulas, reference
from asysplat.rendering.interface import RenderSettings, without_culling
from asysplat.rendering.render import BACKENDS
from asysplat.scene import Cameras, Gaussians

draw_by_cuda = BACKENDS["cuda"]
FIELDS = ("means", "quats", "scales", "opacities", "sh")


@kernel
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cameras_are_packed_to_the_same_bits(make_scene, dtype):
    from asysplat.rendering.cuda import draw as module

    _, cameras = make_batch(make_scene, scenes=2, device=DEVICE)
    poses, intrinsics = cameras.cam_to_world.to(dtype), 1.1 * cameras.intrinsics.to(dtype)
    size, settings = (cameras.height, cameras.width), RenderSettings()
    count = poses[..., 0, 0].numel()
    frame = module.Frame(count, poses.shape[1], 1, 1, *size, columns=1, tiles=1)
    rows = module._pack_cameras(frame, poses, intrinsics, settings)
    assert rows.equal(formulas.camera_rows(poses, intrinsics, size, settings.limits))


def weighted_sum(image):
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    return (image * weights.to(image)).sum()


def run(draw, gaussians, cameras, settings, masks=None):
    """Images, 0 where a pixel does not count, gradients of every input, and statistics."""
    leaves = [getattr(gaussians, name) for name in FIELDS]
    leaves += [cameras.cam_to_world, cameras.intrinsics]
    leaves = [t.detach().requires_grad_() for t in leaves]
    *fields, cam_to_world, intrinsics = leaves
    views = Cameras(intrinsics, cam_to_world, cameras.height, cameras.width)
    out = draw(Gaussians(*fields), views, settings, masks)
    images = [out.image, out.alpha]
    if out.depth is not None:
        origin = 0 if out.depth_origin is None else out.depth_origin
        images.append(out.depth + origin * out.alpha)
    if masks is not None:
        images = [image.where(masks[0], 0) for image in images]
    grads = torch.autograd.grad(sum(map(weighted_sum, images)), leaves)
    return [image.detach() for image in images], grads, out.stats


def make_batch(make_scene, scenes=1, opaque=False, device="cpu", **options):
    """[scenes, N] and [scenes, V], float32."""
    pairs = [make_scene(dtype=torch.float32, seed=seed, **options) for seed in range(scenes)]
    gaussians = Gaussians.stack([scene for scene, _ in pairs])
    if opaque:  # so that clamping and the stop are met
        gaussians.opacities.fill_(0.9999)
        gaussians.scales.mul_(3)
    return gaussians.to(device), Cameras.stack([views for _, views in pairs]).to(device)


def errors(got, exact):
    """Largest error of each image, and the relative L2 errors of the gradients."""
    images = [float((a.double() - b).abs().max()) for a, b in zip(got[0], exact[0], strict=True)]
    grads = zip(got[1], exact[1], strict=True)
    return images, [float((a.double() - b).norm() / b.norm()) for a, b in grads]


CASES = {
    "batch": ({"scenes": 2, "views": 2, "count": 4}, RenderSettings(depth=None)),
    "antialiased": ({"height": 9, "width": 31}, RenderSettings(antialiased=True)),
    "opaque": ({"opaque": True}, RenderSettings(depth="accumulated")),
    "median": (
        {"opaque": True, "degree": 0},
        RenderSettings(depth="median", limits=GSPLAT_1_5),
    ),
    "a pixel": ({"height": 1, "width": 1, "degree": 3}, RenderSettings(depth="median")),
}


@kernel
@pytest.mark.parametrize("name", CASES)
def test_images_and_gradients_are_those_of_the_reference(make_scene, name):
    options, settings = CASES[name]
    scene = make_batch(make_scene, device=DEVICE, **options)
    exact = run(reference.draw, *(part.to(torch.float64) for part in scene), settings)
    got = run(draw_by_cuda, *scene, settings)
    assert exact[0][1].max() > (0.999 if "opaque" in options else 0.3)
    assert len(exact[0]) == (2 if settings.depth is None else 3)
    images, grads = errors(got, exact)
    assert max(images) <= 1e-6
    assert max(grads) <= 5e-6


EXTREMES = {  # norm of the quaternions, smallest and largest scale
    "tiny quaternions": (1e-30, 0.1, 1.0),
    "huge quaternions": (1e25, 0.1, 1.0),
    "dust beside mountains": (1.0, 1e-12, 1e8),
    "dust beside orbits": (1.0, 1e-12, 1e12),
}


def check_extremes(make_scene, extremes, backend, device, image_error, grad_error):
    norm, smallest, largest = EXTREMES[extremes]
    height, width = (17, 20) if INTERPRETED else (33, 40)
    gaussians, cameras = make_batch(make_scene, count=40, height=height, width=width, device=device)
    powers = torch.rand(gaussians.scales.shape, generator=torch.manual_seed(0)).to(device)
    gaussians.scales.copy_(smallest * (largest / smallest) ** powers)
    gaussians.quats.copy_(gaussians.quats / gaussians.quats.norm(dim=-1, keepdim=True) * norm)
    settings, scene = RenderSettings(depth=None), (gaussians, cameras)
    exact = run(reference.draw, *(part.to(torch.float64) for part in scene), settings)
    assert exact[0][1].max() > 0.3
    images, grads = errors(run(BACKENDS[backend], *scene, settings), exact)
    assert max(images) <= image_error and max(grads) <= grad_error


@pytest.mark.parametrize("extremes", EXTREMES)
def test_extreme_numbers_are_as_exact_in_float32(make_scene, extremes):
    check_extremes(make_scene, extremes, "cpu", "cpu", 1e-6, 1e-5)
    check_extremes(make_scene, extremes, "reference", "cpu", 1e-5, 1e-4)


@kernel
@pytest.mark.parametrize("extremes", [*EXTREMES][:-1])  # its gradients are float32
def test_extreme_numbers_are_as_exact_on_a_gpu(make_scene, extremes):
    check_extremes(make_scene, extremes, "cuda", DEVICE, 1e-6, 1e-5)


# The statistic that counts each kind of culling.
GAINS = {
    "opacity": "culled_by_opacity",
    "frustum": "culled_by_frustum",
    "extent": "pairs",
    "ellipse": "pairs_culled_by_ellipse",
    "masks": "pairs_culled_by_masks",
    "opaque": "pairs_culled_by_opaque",
}


@kernel
def test_culling_keeps_the_bits(make_scene):
    gaussians, cameras = make_batch(make_scene, count=20, device=DEVICE)
    gaussians.scales.mul_(torch.tensor([9.0, 0.3, 0.3], device=DEVICE))
    gaussians.opacities[:, ::2] = 0.02
    gaussians.opacities[:, 1] = 1e-3
    gaussians.means[:, 3, 0] = 50
    gaussians.scales[:, 6:8] = 20  # a wall
    gaussians.opacities[:, 6:8] = 0.9999
    masks = torch.ones(1, 1, cameras.height, cameras.width, dtype=torch.bool, device=DEVICE)
    masks[..., :9, :9] = False
    images, grads, stats = run(draw_by_cuda, gaussians, cameras, RenderSettings(), masks)
    for name, gain in GAINS.items():
        with without_culling(name):
            other = run(draw_by_cuda, gaussians, cameras, RenderSettings(), masks)
        assert all(map(torch.equal, [*images, *grads], [*other[0], *other[1]])), name
        assert other[2][gain] != stats[gain], name


@kernel
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see(make_scene, count):
    gaussians, cameras = make_batch(make_scene, scenes=2, views=2, count=count, device=DEVICE)
    gaussians.means[..., 2] -= 20
    images, grads, stats = run(draw_by_cuda, gaussians, cameras, RenderSettings())
    assert all((tensor == 0).all() for tensor in (*images, *grads))
    assert stats["visible"] == 0 and stats["pairs"] == 0


@kernel
def test_float64_is_projected_as_it_is_and_drawn_in_float32(make_scene):
    scene = make_batch(make_scene, count=3, height=8, width=8, device=DEVICE)
    scene = [part.to(torch.float64) for part in scene]
    images, grads, _ = run(draw_by_cuda, *scene, RenderSettings())
    assert {image.dtype for image in images} == {torch.float32}
    assert {grad.dtype for grad in grads} == {torch.float64}
    exact = run(reference.draw, *scene, RenderSettings())
    assert max(errors((images, grads), exact)[0]) <= 1e-6


@pytest.mark.gpu
@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled")
def test_kernels_are_compiled_once_for_all_numbers_of_gaussians_and_views(make_scene, monkeypatch):
    import triton

    compiled = []
    hook = lambda **event: compiled.append(event["fn"].name)  # noqa: E731
    monkeypatch.setattr(triton.knobs.runtime, "jit_post_compile_hook", hook)
    settings = RenderSettings(depth="median", limits=GSPLAT_1_5)
    for count, views in ((33, 3), (1, 1), (16, 2), (64, 16), (35, 1)):
        run(
            draw_by_cuda, *make_batch(make_scene, views=views, count=count, device=DEVICE), settings
        )
    assert max(Counter(compiled).values(), default=0) <= 2, compiled  # list_tiles: twice


@pytest.mark.gpu
@pytest.mark.skipif(INTERPRETED, reason="too large")
def test_a_large_scene_is_the_same_every_time_and_that_of_the_cpu(make_scene):
    scene = make_batch(make_scene, views=3, count=20_000, height=256, width=240, device=DEVICE)
    scene[0].scales.mul_(0.1)
    first = run(draw_by_cuda, *scene, RenderSettings())
    again = run(draw_by_cuda, *scene, RenderSettings())
    assert all(map(torch.equal, [*first[0], *first[1]], [*again[0], *again[1]]))
    images, grads, _ = run(cpu.draw, *(part.to("cpu") for part in scene), RenderSettings())
    for got, image in zip(first[0], images, strict=True):
        off = (got.cpu() - image).abs() > 1e-4 * (1 + image.abs())
        assert off.float().mean() < 1e-3  # at the cut-offs
    for got, grad in zip(first[1], grads, strict=True):
        assert (got.cpu() - grad).norm() < 1e-2 * grad.norm()


@kernel
@pytest.mark.parametrize("shape", ["blobs", "needles"])
def test_tile_lists_hold_what_tiles_show_and_little_more(make_scene, monkeypatch, shape):
    from asysplat.rendering.cuda import draw as module

    found = []

    def keep(frame, pairs, room, settings, keep, active):
        found.append((pairs, list_pairs(frame, pairs, room, settings, True, active)))
        return found[-1][-1]

    list_pairs = module._list_pairs
    monkeypatch.setattr(module, "_list_pairs", keep)
    monkeypatch.setattr(module, "_room", {})
    scene = make_batch(make_scene, views=2, count=60, height=45, width=50)
    if shape == "needles":  # thin and long, the centers of most far outside the image
        scene[0].scales.mul_(torch.tensor([100, 0.05, 0.05]))
        scene[0].means[..., :2].mul_(20)
    stats = draw_by_cuda(*(part.to(DEVICE) for part in scene), RenderSettings()).stats
    ((pairs, lists),) = found
    splats, depths = pairs.splats, pairs.depths
    rows, columns, size = 6, 7, 8
    tiles = rows * columns
    lengths = lists.first_entry.diff()
    assert (lengths >= 0).all() and lengths.sum() == stats["pairs"] == len(lists.entries)
    tile, entries = torch.repeat_interleave(lengths), lists.entries.long()
    assert torch.equal(tile // tiles, entries // 60)
    # Each tile's list is by depth.
    assert (depths[entries].diff()[tile.diff() == 0] >= 0).all()
    # The pairs of a splat are numbered one after the other.
    numbers = lists.places.long().argsort()
    assert torch.equal(lists.places.long()[numbers], torch.arange(len(entries), device=DEVICE))
    counts = torch.bincount(entries, minlength=len(splats))
    ranks = numbers - lists.first_pair[entries]
    assert (ranks >= 0).all() and (ranks < counts[entries]).all()

    # On a grid eight times as fine as pixels, between the outermost pixel centers of each tile.
    offsets = torch.arange(0, size - 0.9, 1 / 8, dtype=torch.float64) + 0.5
    fine_x, fine_y = (
        (torch.arange(0, n * size, size)[:, None] + offsets).clamp_max(pixels - 0.5).flatten()
        for n, pixels in ((columns, 50), (rows, 45))
    )
    drawn = splats[counts > 0].cpu()
    x, y = (drawn.view(torch.int32)[:, :2] + drawn[:, 2:4].double())[..., None, None].unbind(1)
    a, b, c, log_opacity = drawn.double()[:, [4, 5, 6, 9], None, None].unbind(1)
    dx, dy = fine_x - x, fine_y[:, None] - y
    alpha = torch.exp2(log_opacity - ((a * dx + b * dy).square() + (c * dy).square()))
    alpha = alpha.unflatten(2, (columns, -1)).unflatten(1, (rows, -1))
    touched = (alpha.amax((2, 4)) >= 1 / 255).flatten(1)
    listed = torch.zeros(len(splats), tiles, dtype=torch.bool)
    listed[entries.cpu(), tile.cpu() % tiles] = True
    listed = listed[counts.cpu() > 0]
    assert touched.any() and listed[touched].all()
    assert listed.sum() <= 1.05 * touched.sum()


@pytest.mark.skipif(not INTERPRETED, reason="a GPU orders its programs itself")
def test_programs_in_reversed_order_give_the_same_bits(make_scene, monkeypatch):
    from triton.runtime.interpreter import interpreter_builder

    scene, settings = make_batch(make_scene, views=2, device=DEVICE), RenderSettings()
    images, grads, stats = run(draw_by_cuda, *scene, settings)
    place, placed = interpreter_builder.set_grid_idx, []

    def mirror(*program):
        counts = interpreter_builder.grid_dim
        placed.append(tuple(n - 1 - i for n, i in zip(counts, program, strict=True)))
        place(*placed[-1])

    monkeypatch.setattr(interpreter_builder, "set_grid_idx", mirror)
    other = run(draw_by_cuda, *scene, settings)
    assert placed != sorted(placed) and other[2] == stats
    assert all(map(torch.equal, [*images, *grads], [*other[0], *other[1]]))


@kernel
def test_pairs_beyond_the_room_are_drawn_again(make_scene, monkeypatch):
    from asysplat.rendering.cuda import draw as module

    monkeypatch.setattr(module, "_room", {})
    scene, settings = make_batch(make_scene, scenes=2, views=2, device=DEVICE), RenderSettings()
    images, grads, stats = run(draw_by_cuda, *scene, settings)
    ((similar, room),) = module._room.items()
    assert room > stats["pairs"] > 16
    for others in (16, 10 * room):  # pairs that the images before had
        monkeypatch.setattr(module, "_room", {similar: others})
        other = run(draw_by_cuda, *scene, settings)
        assert all(map(torch.equal, [*images, *grads], [*other[0], *other[1]]))
        assert other[2] == stats
        assert stats["pairs"] < module._room[similar] <= max(room, others)


@kernel
def test_a_room_that_memory_does_not_hold_is_forgotten(make_scene, monkeypatch):
    from asysplat.rendering.cuda import draw as module

    monkeypatch.setattr(module, "_room", {})
    scene, settings = make_batch(make_scene, count=3, device=DEVICE), RenderSettings()
    image = draw_by_cuda(*scene, settings).image
    module._room.update(dict.fromkeys(module._room, 2**45))
    with pytest.raises(RuntimeError, match="memory"):
        draw_by_cuda(*scene, settings)
    assert draw_by_cuda(*scene, settings).image.equal(image)


@kernel
@pytest.mark.parametrize("parts", [3, 1000])
def test_gradients_of_a_group_of_tiles_at_a_time(make_scene, monkeypatch, parts):
    """Several tiles, or one alone, as it has more pairs than a group should have."""
    from asysplat.rendering.cuda import draw as module

    scene, settings = make_batch(make_scene, views=2, device=DEVICE), RenderSettings()
    images, grads, stats = run(draw_by_cuda, *scene, settings)
    most = 1 + stats["pairs"] // parts
    monkeypatch.setattr(module, "MOST_ROWS", most)
    groups = []

    def keep(*args):
        groups.append(group_tiles(*args))
        return groups[-1]

    group_tiles = module._group_tiles
    monkeypatch.setattr(module, "_group_tiles", keep)
    other = run(draw_by_cuda, *scene, settings)
    ((bounds, rows),) = groups
    assert len(bounds) > 3 and bounds[0] == 0 and bounds == sorted(set(bounds))
    assert bounds[-1] == 2 * -(-scene[1].height // 8) * -(-scene[1].width // 8)
    assert most / 2 < rows < stats["pairs"] / 2
    assert all(map(torch.equal, images, other[0]))
    for grad, whole in zip(other[1], grads, strict=True):
        torch.testing.assert_close(grad, whole, rtol=1e-6, atol=1e-6 * float(whole.abs().max()))


@kernel
@pytest.mark.parametrize(
    "limit, value, found",
    [
        ("MAX_PAIRS", 3, r"\d+ pairs.* 3: "),
        ("MAX_IMAGES", 1, r"2 views.* 1[ :].*"),
        ("MAX_SPLATS", 1, r"12 Gaussians.* 1[ :].*"),
    ],
)
def test_too_many_pairs_or_splats_are_an_error(make_scene, monkeypatch, limit, value, found):
    monkeypatch.setattr(f"asysplat.rendering.interface.{limit}", value)
    with pytest.raises(InputError, match=f"{found}set views_at_once"):
        draw_by_cuda(*make_batch(make_scene, views=2, device=DEVICE), RenderSettings())


@kernel
def test_indices_of_an_image_beyond_int32_are_right():
    """The last tile of the second of two images of 40,000 x 40,000 pixels."""
    from pixel_kernel import write_indices

    side, columns = 40_000, 5000
    out = torch.empty(4, 64, dtype=torch.int64, device=DEVICE)
    write_indices[(1,)](out, 2 * columns**2 - 1, columns, columns**2, side, side)
    planes = out[:, -1].tolist()
    assert planes == [plane * side**2 - 1 for plane in (2, 4, 5, 6)]


@pytest.mark.skipif(INTERPRETED, reason="a CPU will do there")
def test_tensors_on_a_cpu_are_an_error(make_scene):
    pytest.importorskip("triton")
    with pytest.raises(InputError, match=r"'cuda'.* cpu: choose 'auto'.*to\('cuda'\)"):
        draw_by_cuda(*make_batch(make_scene), RenderSettings())


def test_without_triton_an_error_says_what_to_install(make_scene, monkeypatch):
    for name in list(sys.modules):
        if name.startswith(("asysplat.rendering.cuda.", "asysplat.kernels.triton_utils")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(InputError, match="'cuda' needs triton: pip install triton"):
        draw_by_cuda(*make_batch(make_scene), RenderSettings())
