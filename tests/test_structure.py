"""What makes code quick to read: how much a file pulls in, how many arguments a call lines up."""

import ast

import pytest

MOST_FILES = 15  # of which the renderer for CPUs consists
MOST_ARGUMENTS = 8  # without their names


@pytest.fixture(scope="module")
def sources(repository):
    """Module name -> syntax tree, of asysplat and the scripts."""
    paths = [*(repository / "asysplat").rglob("*.py"), *repository.glob("*.py")]
    names = {path: path.relative_to(repository).with_suffix("").parts for path in paths}
    return {
        ".".join(parts[:-1] if parts[-1] == "__init__" else parts): ast.parse(path.read_text())
        for path, parts in names.items()
    }


def imported(tree, sources):
    """The modules of this project that a file names in its import statements."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in sources else node.module


def closure(module, sources):
    found, waiting = set(), [module]
    while waiting:
        name = waiting.pop()
        if name in sources and name not in found:
            found.add(name)
            waiting.extend(imported(sources[name], sources))
    return found


def test_the_renderer_for_cpus_is_few_files(sources):
    files = closure("asysplat.rendering.cpu.draw", sources)
    assert "asysplat.scene" in files  # the closure is not empty by mistake
    assert len(files) <= MOST_FILES, sorted(files)


def test_no_call_lines_up_many_arguments(sources):
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
    assert len(calls) > 5000
    assert [call for call in calls if call[2] > MOST_ARGUMENTS] == []
