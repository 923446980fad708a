"""The kernels with streams, a second device, CUDA graphs, large scenes and too little memory."""

import re
import warnings
from dataclasses import astuple

import pytest
import torch
from compiler import DEVICE, INTERPRETED

from asysplat import ops
from asysplat.cli import error_message
from asysplat.errors import InputError
from asysplat.kernels.self_check import TOLERANCE, relative_error, seeded_normal
from asysplat.ops import self_check
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(INTERPRETED, reason="of CUDA, and too large for the interpreter"),
]

LENGTH = 8192  # tokens
# Sizes of x's channels and of A, and the size of the state.
SCANS = {"ssd": ((4, 64), (4,), 64), "selective_scan": ((128,), (128, 16), 16)}
KERNELS = (*SCANS, "render")
GB = 1e9
NUM, HEIGHT, WIDTH = 5_000_000, 540, 960
ROUNDING = 1e-5  # relative error


def prepare(name, make_scene, device=DEVICE):
    """Return a function that runs kernels, and its inputs, the same on every device."""
    if name != "render":
        return scan(name), scan_inputs(name, seeded_normal(torch.device(device), torch.float32))
    scene = make_scene(count=2000, views=2, height=120, width=160, dtype=torch.float32)
    gaussians, cameras = (part.to(device) for part in scene)
    return renderer(cameras), leaves(*astuple(gaussians))


def scan(name):
    return lambda *inputs: (getattr(ops, name)(*inputs, backend="cuda"),)


def scan_inputs(name, draw):
    channels, decays, state = SCANS[name]
    x, B, C = draw(2, LENGTH, *channels), draw(2, LENGTH, state), draw(2, LENGTH, state)
    dt, A = 0.1 * draw(2, LENGTH, channels[0]).sigmoid(), -draw(*decays).exp()
    return leaves(x, dt, A, B, C, draw(channels[0]))


def renderer(cameras, **options):
    def draw(*fields):
        out = render(Gaussians(*fields), cameras, backend="cuda", **options)
        return [image for image in (out.image, out.alpha, out.depth) if image is not None]

    return draw


def leaves(*tensors):
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def both_passes(function, inputs):
    """Return the outputs, and the gradients of half the sum of their squares."""
    outputs = function(*inputs)
    values = [output.detach() for output in outputs]
    return [*values, *torch.autograd.grad(outputs, inputs, values)]


def same_bits(results, others):
    return len(results) == len(others) and all(map(torch.equal, results, others))


def test_two_streams_at_a_time_give_the_bits_of_one(make_scene):
    work = {name: prepare(name, make_scene) for name in KERNELS}
    expected = {name: both_passes(*work[name]) for name in work}
    torch.cuda.synchronize()
    scans, drawing = torch.cuda.Stream(), torch.cuda.Stream()
    for _ in range(3):
        with torch.cuda.stream(scans):  # returns before the GPU has begun
            found = {name: both_passes(*work[name]) for name in SCANS}
        with torch.cuda.stream(drawing):
            found["render"] = both_passes(*work["render"])
        torch.cuda.synchronize()
        for name in work:
            assert same_bits(found[name], expected[name]), name


two_devices = pytest.mark.skipif(
    torch.cuda.device_count() < 2, reason="needs two CUDA devices in one machine"
)


@two_devices
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_run_on_a_device_that_is_not_the_current_one(make_scene, name):
    with torch.cuda.device(0):
        expected = both_passes(*prepare(name, make_scene, "cuda:0"))
        found = both_passes(*prepare(name, make_scene, "cuda:1"))
        assert torch.cuda.current_device() == 0
    assert {tensor.device for tensor in found} == {torch.device("cuda", 1)}
    # Two kinds of GPU may round differently.
    assert relative_error([tensor.to("cuda:0") for tensor in found], expected) <= ROUNDING


@two_devices
@pytest.mark.parametrize("name", ["adam", "plane_sweep", "image_loss", "conv_silu"])
def test_references_agree_on_a_device_that_is_not_the_current_one(name):
    with torch.cuda.device(0):
        errors = getattr(self_check, name)(torch.device("cuda", 1), "cuda")
        assert max(errors.values()) <= TOLERANCE


@pytest.mark.parametrize("name", SCANS)
def test_a_scan_in_a_cuda_graph_is_replayed_with_new_inputs(name):
    function, draw = scan(name), seeded_normal(torch.device(DEVICE), torch.float32)
    inputs, others = scan_inputs(name, draw), scan_inputs(name, draw)
    expected = both_passes(function, others)
    first = torch.cuda.Stream()
    first.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(first):
        for _ in range(3):
            both_passes(function, inputs)
    torch.cuda.current_stream().wait_stream(first)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = both_passes(function, inputs)
    with torch.no_grad():
        for tensor, other in zip(inputs, others, strict=True):
            tensor.copy_(other)
    graph.replay()
    torch.cuda.synchronize()
    assert same_bits(found, expected)


@pytest.mark.filterwarnings("ignore:The CUDA Graph is empty")
def test_a_render_in_a_cuda_graph_is_an_error_and_leaves_the_gpu_usable(make_scene):
    function, inputs = prepare("render", make_scene)
    expected = both_passes(function, inputs)
    graph = torch.cuda.CUDAGraph()
    with (
        pytest.raises(InputError, match=r"call it outside torch.cuda.graph.$"),
        torch.cuda.graph(graph),
    ):
        function(*inputs)
    assert same_bits(both_passes(function, inputs), expected)


def large_scene(num, degree, radius):
    """Gaussians of `radius` pixels and more, spread over an image; fields that need gradients."""
    generator = torch.Generator(DEVICE).manual_seed(0)

    def uniform(*shape):
        return torch.rand(shape, generator=generator, device=DEVICE)

    depths = 2 + 4 * uniform(num, 1)
    sides = torch.tensor([1.0, HEIGHT / WIDTH], device=DEVICE)
    means = torch.cat(((uniform(num, 2) - 0.5) * sides * depths, depths), 1)
    quats = torch.tensor([1.0, 0, 0, 0], device=DEVICE).repeat(num, 1)
    scales = radius / WIDTH * depths * torch.tensor([1.0, 1.2, 1.4], device=DEVICE)
    opacities = torch.full((num,), 0.05, device=DEVICE)
    return leaves(means, quats, scales, opacities, 0.3 * uniform(num, (degree + 1) ** 2, 3))


def cameras_looking(*directions):
    """Cameras at the origin; -1 looks away from the scene."""
    lens = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
    poses = torch.stack([torch.diag(torch.tensor([d, 1.0, d, 1.0])) for d in directions])
    return Cameras(lens.repeat(len(poses), 1, 1), poses, HEIGHT, WIDTH).to(DEVICE)


def need_memory(size):
    torch.cuda.empty_cache()
    free = torch.cuda.mem_get_info()[0]
    if free < size:
        pytest.skip(f"needs {size / GB:.0f} GB of free memory: there are {free / GB:.0f}")


def test_five_million_gaussians():
    """Both passes: finite, in the memory that is stated here, and the same view by view."""
    need_memory(16 * GB)
    inputs = large_scene(NUM, degree=3, radius=0.7)
    cameras = cameras_looking(1.0, 1.0)
    cameras.cam_to_world[1, 0, 3] = 0.1
    with torch.no_grad():
        stats = render(Gaussians(*inputs), cameras, backend="cuda").stats
    assert stats["visible"] > 1.9 * NUM and stats["pairs"] > 1.5 * stats["visible"]
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    results = both_passes(renderer(cameras), inputs)
    peak = torch.cuda.max_memory_allocated() - before
    gradients = sum(tensor.nbytes for tensor in inputs)
    images = sum(image.nbytes for image in results[:3])
    # A splat has 64 bytes, a pair's gradient 40; the rest is for sorting.
    assert peak <= gradients + 128 * 2 * NUM + 128 * stats["pairs"] + 8 * images
    assert all(result.isfinite().all() for result in results)
    assert results[1].mean() > 0.5
    for result, other in zip(
        results, both_passes(renderer(cameras, views_at_once=1), inputs), strict=True
    ):
        assert (result - other).norm() <= ROUNDING * other.norm()


def test_more_splats_and_gradients_than_int32_has_numbers():
    """Only the last view sees the Gaussians: it is that of this view alone."""
    need_memory(48 * GB)
    views = 27
    inputs = large_scene(NUM, degree=0, radius=11.5)
    assert 16 * views * NUM > 2**31
    cameras = cameras_looking(*[-1.0] * (views - 1), 1.0)
    with torch.no_grad():
        stats = render(Gaussians(*inputs), cameras, backend="cuda", depth=False).stats
    assert stats["visible"] <= NUM and 10 * stats["pairs"] > 2**31
    expected = both_passes(renderer(cameras_looking(1.0), depth=False), inputs)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "render: memory")  # in parts, no index would be large
        image, alpha, *gradients = both_passes(renderer(cameras, depth=False), inputs)
    assert not image[:-1].any() and not alpha[:-1].any()
    assert same_bits([image[-1:], alpha[-1:], *gradients], expected)


@pytest.fixture
def limit_memory():
    """Limit the bytes that tensors take of the GPU's memory, until the test's end."""

    def limit(size):
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        size += torch.cuda.memory_reserved() - torch.cuda.memory_allocated()  # gaps stay reserved
        torch.cuda.set_per_process_memory_fraction(size / torch.cuda.mem_get_info()[1])

    yield limit
    torch.cuda.set_per_process_memory_fraction(1.0)


def forward_peak(function, inputs):
    """Return the images, on the CPU, and the peak of all memory that is allocated."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    with torch.no_grad():
        images = [image.cpu() for image in function(*inputs)]
    return images, torch.cuda.max_memory_allocated()


def test_a_render_without_memory_for_all_views_draws_fewer_at_a_time(limit_memory):
    need_memory(8 * GB)
    inputs = large_scene(NUM // 5, degree=0, radius=0.7)
    cameras = cameras_looking(*[1.0] * 16)
    expected, most = forward_peak(renderer(cameras), inputs)
    _, least = forward_peak(renderer(cameras, views_at_once=1), inputs)
    assert most > 2 * least
    limit_memory((most + least) / 2)
    said = r"memory does not hold so many views .* drawing \d at a time.*\(views_at_once=\d\)"
    with pytest.warns(UserWarning, match=re.compile(said, re.DOTALL)):
        found, _ = forward_peak(renderer(cameras), inputs)
    assert same_bits(found, expected)


def test_a_gpu_without_memory_is_a_sentence(limit_memory):
    need_memory(8 * GB)
    inputs = large_scene(NUM // 5, degree=0, radius=0.7)
    limit_memory(torch.cuda.memory_allocated() + 2**22)  # the splats take 2**26
    with pytest.raises(torch.OutOfMemoryError) as raised:
        renderer(cameras_looking(1.0))(*inputs)
    sentence = r"there is no memory left \(CUDA out of memory\. Tried to allocate [\d.]+ [KMG]iB\)"
    assert re.fullmatch(
        sentence + r": choose fewer or smaller views.*", error_message(raised.value)
    )
