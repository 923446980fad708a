"""The structure of the code: import order, size of import closures, arguments of calls, names."""

import ast
import re
from collections import defaultdict
from graphlib import TopologicalSorter

import pytest

MAX_FILES = 14  # of the CPU renderer
MAX_ARGUMENTS = 8  # passed by position
BRITISH = (
    "colour",
    "centre",
    "grey",
    "neighbour",
    "normalise",
    "optimis",
    "initialis",
    "behaviour",
)
# Packages and modules of asysplat: each imports only from layers before its own.
LAYERS = (
    ("errors", "interrupts", "root"),
    ("files", "kernels", "overrides", "ranges", "scene", "terminal"),
    ("cli",),
    ("geometry", "ops"),
    ("data", "models", "rendering"),
    ("refinement",),
    ("evaluation",),
    ("runs", "export"),
    ("training",),
    ("load",),
    ("reconstruct",),
    ("doctor", "import_weights", "__main__"),
)


@pytest.fixture(scope="module")
def sources(repository):
    """Module name -> syntax tree, of asysplat, the benchmarks and the scripts."""
    paths = [*repository.glob("*.py")]
    for folder in ("asysplat", "benchmarks", "paper"):
        paths += (repository / folder).rglob("*.py")
    names = {path: path.relative_to(repository).with_suffix("").parts for path in paths}
    return {
        ".".join(parts[:-1] if parts[-1] == "__init__" else parts): ast.parse(path.read_text())
        for path, parts in names.items()
    }


def imported(tree, sources):
    """The modules that a file imports; a package if it imports a name from the package itself."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in sources else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def closure(module, sources):
    found, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name in sources and name not in found:
            found.add(name)
            waiting.extend(imported(sources[name], sources))
    return found


def unit(module):
    """The package or module directly inside asysplat; None for asysplat itself and scripts."""
    first, *inner = module.split(".")
    return inner[0] if first == "asysplat" and inner else None


def test_imports_go_to_lower_layers(sources):
    layer = {name: place for place, names in enumerate(LAYERS) for name in names}
    units = {unit(module) for module in sources} - {None}
    assert units == set(layer)
    upward = [
        (module, name)
        for module, tree in sources.items()
        for name in imported(tree, sources)
        if unit(module) and name in sources and unit(name) != unit(module)
        if unit(name) is None or layer[unit(name)] >= layer[unit(module)]
    ]
    assert upward == []


def test_imports_have_no_cycle(sources):
    graph = {
        module: {name for name in imported(tree, sources) if name in sources and name != module}
        for module, tree in sources.items()
    }
    assert len(list(TopologicalSorter(graph).static_order())) == len(sources)


def test_the_cpu_renderer_has_few_files(sources):
    files = closure("asysplat.rendering.cpu.draw", sources)
    assert "asysplat.scene" in files  # the closure is not empty by mistake
    assert len(files) <= MAX_FILES, sorted(files)


def test_loading_a_network_needs_no_lightning(sources):
    files = closure("asysplat.load", sources)
    assert "asysplat.runs.checkpoints" in files
    names = {name for file in files for name in imported(sources[file], sources)}
    assert not any(name.startswith("lightning") for name in names)


def test_calls_have_few_positional_arguments(sources):
    def count(call):
        parts = [arg.value if isinstance(arg, ast.Starred) else arg for arg in call.args]
        starred = [isinstance(arg, ast.Starred) for arg in call.args]
        return sum(
            len(part.elts) if star and isinstance(part, ast.Tuple | ast.List) else 1
            for part, star in zip(parts, starred, strict=True)
        )

    calls = [
        (name, node.lineno, count(node))
        for name, tree in sources.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
    ]
    assert calls
    assert [call for call in calls if call[2] > MAX_ARGUMENTS] == []


def test_a_public_class_has_a_name_of_its_own(sources):
    """Twins of an operator have the same names in reference, cpu and cuda."""
    places = defaultdict(set)
    for module, tree in sources.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].add(re.sub(r"\.(reference|cpu|cuda)(?=\.|$)", "", module))
    assert places
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def test_names_are_american(repository):
    files = [*repository.glob("*.py")]
    for folder in ("asysplat", "benchmarks", "conf", "paper"):
        files += [*(repository / folder).rglob("*.py"), *(repository / folder).rglob("*.yaml")]
    # Names in the files of finished runs stay what they were.
    texts = [path.read_text() for path in files if path.name != "old_names.py"]
    words = {word.lower() for text in texts for word in re.findall(r"\w+", text)}
    assert words
    assert [word for word in words if any(part in word for part in BRITISH)] == []


def test_every_command_handles_signals(repository):
    """Else pycolmap's handler of SIGTERM prints a stack trace."""
    files = [*repository.glob("*.py"), *repository.glob("examples/*.py")]
    files += (repository / "asysplat").rglob("*.py")
    parts = {path: path.read_text().split('if __name__ == "__main__":') for path in files}
    commands = {path: blocks[-1] for path, blocks in parts.items() if len(blocks) > 1}
    assert len(commands) > 10
    handled = {path for path, block in commands.items() if "    handle_signals()" in block}
    handled |= {path for path in commands if "@command(" in path.read_text()}
    assert set(commands) == handled
