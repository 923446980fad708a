"""Compile a launch for a GPU that is not at hand; read registers, memory and instructions."""

import re
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, CompiledKernel

from benchmarks.machine_code.launches import Launch

TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
TYPES = {torch.bfloat16: "bf16", torch.float16: "fp16", torch.float32: "fp32"}
TYPES |= {torch.float64: "fp64", torch.int8: "i8", torch.int16: "i16", torch.int32: "i32"}
TYPES |= {torch.int64: "i64", torch.bool: "i1"}
DIVISIBLE = [["tt.divisibility", 16]]
LANES = 32  # of a warp
REGISTERS, REGISTER_BLOCK = 65536, 256  # of a multiprocessor; allocated to a warp at a time
RESERVED_SHARED = 1024  # bytes of shared memory that each block takes besides its own


class Limits(NamedTuple):
    """Limits of a multiprocessor (CUDA C++ Programming Guide, compute capabilities)."""

    warps: int
    blocks: int
    shared: int  # bytes; a block can use 1 kB less


LIMITS = {
    80: Limits(64, 32, 167936),
    89: Limits(48, 24, 102400),
    90: Limits(64, 32, 233472),
    100: Limits(64, 32, 233472),
}


class Usage(NamedTuple):
    """What a thread and a block of a compiled kernel take, and what they execute.

    instructions counts SASS instructions of a warp by class, per loop: the first entry is outside
    of loops, the others one loop each, from its first instruction to its branch back.
    """

    registers: int  # registers of a thread
    stack: int  # bytes of a thread, in memory: spilled registers
    shared: int  # bytes of a block
    warps: int  # warps of a block
    occupancy: float  # warps that fit on a multiprocessor, as a fraction of its limit
    instructions: list[Counter[str]]


def without_repeats(launches: Iterable[Launch], capability: int) -> list[Launch]:
    """Return the first of the launches that need the same compilation."""
    first: dict[str, Launch] = {}
    for launch in launches:
        source, _, options = _source(launch.kernel, launch.arguments, capability)
        constants = source.signature, source.constants, source.attrs, options
        first.setdefault(f"{launch.name} {constants}", launch)
    return list(first.values())


def compile_launch(launch: Launch, capability: int) -> CompiledKernel:
    """Compile a launch as Triton's launcher would, for a compute capability such as 90."""
    return triton.compile(*_source(launch.kernel, launch.arguments, capability))


def measure_usage(compiled: CompiledKernel, capability: int) -> Usage:
    """Read what a compiled kernel takes from its cubin."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        resources = _run_tool("cuobjdump", "--dump-resource-usage", file.name)
        sass = _run_tool("nvdisasm", "-c", file.name)
    numbers = {name: int(value) for name, value in re.findall(r"(REG|STACK):(\d+)", resources)}
    warps, shared = compiled.metadata.num_warps, compiled.metadata.shared
    limits = LIMITS[capability]
    warp_registers = -(-numbers["REG"] * LANES // REGISTER_BLOCK) * REGISTER_BLOCK
    blocks = min(
        REGISTERS // warp_registers // warps,
        limits.warps // warps,
        limits.blocks,
        limits.shared // (shared + RESERVED_SHARED),
    )
    return Usage(
        registers=numbers["REG"],
        stack=numbers["STACK"],
        shared=shared,
        warps=warps,
        occupancy=blocks * warps / limits.warps,
        instructions=count_instructions(sass),
    )


def count_instructions(sass: str) -> list[Counter[str]]:
    """Count the instructions of a disassembly by class; see `Usage`.

    Subroutines, the slow ways of divisions, come behind the kernel's end and are not counted.
    """
    lines, labels, loops = [], {}, []
    for line in sass.splitlines():
        if label := re.match(r"\.(L_x_\d+):", line.strip()):
            labels[label[1]] = len(lines)
        elif line.strip().startswith("$__internal"):
            break
        elif instruction := re.match(
            r"\s+/\*[0-9a-f]+\*/\s+(?:@!?U?P\w+ )?\s*([A-Z][\w.]*)(.*)", line
        ):
            name, rest = instruction[1], instruction[2]
            target = re.search(r"`\(\.(L_x_\d+)\)", rest)
            if name.startswith("BRA") and target and target[1] in labels:
                start = labels[target[1]]
                if start < len(lines):  # the kernel's end is a jump to itself
                    loops.append((start, len(lines)))
            lines.append(name)
    merged: dict[int, int] = {}
    for start, end in loops:  # a loop with several branches back ends at the last
        merged[start] = max(end, merged.get(start, 0))
    counts = [Counter() for _ in range(len(merged) + 1)]
    ordered = sorted(merged.items())
    for place, name in enumerate(lines):
        inside = [i for i, (start, end) in enumerate(ordered, 1) if start <= place <= end]
        counts[inside[-1] if inside else 0][_classify(name)] += 1
    return counts


def _classify(name: str) -> str:
    stem = name.split(".")[0]
    if stem in ("DADD", "DMUL", "DFMA", "DSETP") or (
        stem in ("F2F", "F2I", "I2F") and "F64" in name
    ):
        return "float64"
    if stem == "MUFU":
        return "special"
    if stem in ("LDG", "STG", "LD", "ST"):
        return "memory"
    if stem in ("HMMA", "HGMMA", "UTCHMMA"):
        return "matrix"
    return "other"


def _source(
    kernel: Any, arguments: dict[str, Any], capability: int
) -> tuple[ASTSource, GPUTarget, dict[str, Any]]:
    """Return the source, specialized for the values of the arguments, target and options."""
    options, signature, constants, attributes = dict(arguments), {}, {}, {}
    for index, parameter in enumerate(kernel.params):
        name, value = parameter.name, options.pop(parameter.name)
        specialized = not parameter.do_not_specialize
        is_number = isinstance(value, int) and not isinstance(value, bool)
        if parameter.is_constexpr or value is None or (is_number and specialized and value == 1):
            signature[name], constants[name] = "constexpr", value
        elif isinstance(value, Tensor):
            signature[name] = "*" + TYPES[value.dtype]
            attributes[index,] = DIVISIBLE
        elif isinstance(value, float):
            signature[name] = "fp32"
        else:
            signature[name] = "i32" if abs(value) < 2**31 else "i64"
            if specialized and value % 16 == 0:
                attributes[index,] = DIVISIBLE
    source = ASTSource(kernel, signature, constants, attributes)
    return source, GPUTarget("cuda", capability, LANES), options


def _run_tool(name: str, *arguments: str) -> str:
    done = subprocess.run([TOOLS / name, *arguments], capture_output=True, text=True, check=True)
    return done.stdout
