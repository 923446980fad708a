"""All kernels are compiled as they are launched, for GPUs that are not at hand.

The interpreter takes what the compiler may not, and knows no registers.
"""

import ast
import re
from collections import Counter

import pytest
from compiler import INTERPRETED

pytest.importorskip("triton")
if INTERPRETED:
    pytest.skip("Triton interprets its kernels here", allow_module_level=True)

from benchmarks.machine_code.cubin import (
    LANES,
    LIMITS,
    RESERVED_SHARED,
    compile_launch,
    count_instructions,
    measure_usage,
    without_repeats,
)
from benchmarks.machine_code.estimate import CARDS, estimate
from benchmarks.machine_code.launches import _render, keep_one_pair, record_launches, recording

SCANS = ("pass_states", "forward_chunk")
KERNELS = {
    "rendering": {"pack_cameras", "project", "list_tiles", "list_entries", "rasterize"}
    | {"rasterize_backward", "sum_pairs", "project_backward"},
    "plane_sweep": {"cost_band", "add_paths", "count_views", "spread_lines"},
    "selective_scan": {"sum_chunk", "backward_chunk", *SCANS},
    "ssd": {"sum_decays", "score_chunk", "head_gradients", "score_gradients"}
    | {"projection_gradients", *SCANS},
    "conv_silu": {"forward_band", "backward_band"},
    "adam": {"drop_not_finite", "update_rows"},
    "image_loss": {"compare_windows", "compare_pixels"},
}
MAX_STACK = 256  # bytes of a thread: registers spilled to memory
# Hopper's TF32 products; SSD is nearly twice as fast with them on an H200.
LARGER_STACKS = {(90, "ssd.head_gradients"): 384, (90, "ssd.pass_states"): 272}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("capability", [80, 90, 100])
def test_every_launch_compiles_and_fits(capability):
    launches = without_repeats(record_launches(capability), capability)
    names = {f"{package}.{name}" for package, names in KERNELS.items() for name in names}
    assert {launch.name for launch in launches} == names
    variants = Counter(launch.name.partition(".")[0] for launch in launches)
    assert variants.pop("conv_silu") <= 6 and variants.pop("image_loss") <= 6
    assert variants.total() < 90
    for launch in launches:
        usage = measure_usage(compile_launch(launch, capability), capability)
        name = f"{launch.name} of {launch.case}"
        max_stack = LARGER_STACKS.get((capability, launch.name), MAX_STACK)
        assert usage.stack <= max_stack, (name, usage)
        assert usage.shared + RESERVED_SHARED <= LIMITS[capability].shared, (name, usage)
        assert usage.occupancy > 0, (name, usage)
        if launch.kernel_name in ("rasterize", "rasterize_backward", "sum_pairs"):
            assert not any("float64" in counts for counts in usage.instructions), name


@pytest.mark.parametrize("capability", [80, 90, 100])
def test_a_splat_is_few_instructions_of_memory_none_waiting_for_a_store(capability):
    launches = without_repeats(record_launches(capability), capability)
    launches = [launch for launch in launches if launch.case.startswith("render")]
    # Columns of 8 bytes but for red; the entry; backward, one store.
    allowed = {"rasterize": 9, "rasterize_backward": 10}
    hot = [launch for launch in launches if launch.kernel_name in allowed]
    assert {launch.kernel_name for launch in hot} == allowed.keys()
    for launch in hot:
        compiled, step = compile_launch(launch, capability), launch.arguments["STEP"]
        loop = max(measure_usage(compiled, capability).instructions[1:], key=Counter.total)
        assert 0 < loop["memory"] <= allowed[launch.kernel_name] * step, (launch.case, loop)
        if launch.kernel_name == "rasterize_backward":
            accesses = re.findall(r"\b(ld|st)\.global", compiled.asm["ptx"])
            first = accesses.index("st")
            assert accesses[first : first + step] == ["st"] * step, launch.case


def test_a_rendering_is_compiled_once_for_all_numbers_of_gaussians_and_views():
    with recording() as (launches, fills):
        fills[:] = [keep_one_pair]
        for num, views in ((33, 3), (1, 1), (16, 2), (64, 4)):
            _render(0, views, True, num=num)
    found = Counter(launch.kernel_name for launch in without_repeats(launches, 90))
    twice = {"list_tiles": 2, "project_backward": 2}  # counts and lists; one view and several
    assert found == dict.fromkeys(KERNELS["rendering"], 1) | twice


def test_no_lane_loads_a_step_of_adam_that_another_has_stored():
    launches = without_repeats(record_launches(90), 90)
    launches = [launch for launch in launches if launch.kernel_name == "update_rows"]
    # With 12 and 48 numbers several lanes load a row's step, each for itself.
    assert {launch.arguments["NUMBERS"] for launch in launches} == {1, 3, 4, 12, 48}
    for launch in launches:
        ptx = compile_launch(launch, 90).asm["ptx"]
        events = re.findall(r"\bld\.global|\bst\.global|\bbar\.sync", ptx)
        assert "bar.sync" in events[: events.index("st.global")], launch.arguments["NUMBERS"]


def test_no_lane_repeats_the_work_of_another():
    one_each = {"project", "list_tiles", "project_backward"}  # a lane for each number of a block
    launches = [launch for launch in record_launches(90) if launch.kernel_name in one_each]
    assert {launch.kernel_name for launch in launches} == one_each
    for launch in launches:
        lanes = launch.arguments.get("num_warps", 4) * LANES  # Triton's default is 4
        assert lanes == launch.arguments["BLOCK"], launch.case


def test_ssd_stores_states_in_the_type_of_its_products_factors():
    launches = [launch for launch in record_launches(90) if launch.name.startswith("ssd.")]
    for launch in launches:
        for name in {"states", "grad_states"} & launch.arguments.keys():
            bits = 8 * launch.arguments[name].element_size()
            assert bits == launch.arguments["DOT"].primitive_bitwidth, (launch.name, launch.case)


SASS = """
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_0:
        /*0010*/                   LDG.E R2, [R4] ;
.L_x_1:
        /*0020*/                   DFMA R6, R2, R2, R6 ;
        /*0030*/              @!P0 BRA `(.L_x_1) ;
        /*0040*/               @P1 BRA `(.L_x_2) ;
        /*0050*/              @!P2 BRA `(.L_x_0) ;
.L_x_2:
        /*0060*/                   MUFU.RCP R3, R2 ;
        /*0070*/                   EXIT ;
.L_x_3:
        /*0080*/                   BRA `(.L_x_3);
$__internal_0_$__cuda_sm20_div_rn_f64_full:
        /*0090*/                   DMUL R2, R2, R2 ;
"""


def test_instructions_are_counted_by_loop():
    outside, loop, inner = count_instructions(SASS)
    assert outside == {"other": 3, "special": 1}
    assert loop == {"memory": 1, "other": 2}
    assert inner == {"float64": 1, "other": 1}


def test_a_kernel_takes_as_long_as_its_slowest_resource():
    card = CARDS["RTX 4090"]._replace(multiprocessors=10, clock=1e6)
    counts = count_instructions(SASS)
    seconds, bound = estimate(card, counts, (1.0, 2.0, 20.0), warps=100, traffic=0.0)
    assert bound == "float64" and seconds == pytest.approx(20 * 16 * 100 / 10 / 1e6)
    assert estimate(card, counts[:1], (1.0,), warps=1, traffic=1e12)[1] == "bytes"


def test_kernels_unpack_no_tuple_within_a_tuple(repository):
    """Triton 3.6, which torch 2.11 needs, does not read `(a, b), c = ...`."""
    paths = [*(repository / "asysplat").rglob("cuda/*.py")]
    paths += (repository / "asysplat").rglob("cuda.py")
    kernels = [
        node
        for tree in (ast.parse(path.read_text()) for path in paths)
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(name, ast.Name) and name.id == "kernel" for name in node.decorator_list)
    ]
    formulas = ast.parse((repository / "asysplat/rendering/formulas.py").read_text())
    assert kernels
    for node in ast.walk(ast.Module([*kernels, formulas], [])):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            names = node.targets[0].elts
            assert not any(isinstance(name, ast.Tuple) for name in names), ast.unparse(node)
