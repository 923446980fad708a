"""Names that were replaced by the field's words stay out of the code and the configuration."""

import ast
from collections import defaultdict

import pytest
import yaml

REPLACED = {
    *("Reconstruction", "reconstruction", "held_back", "SETS_ASIDE", "made_up", "stand_in"),
    *("Capture", "PhotographCapture", "shake", "Pulls", "pulls", "gaussians_where_wrong", "look"),
    *("seen_at", "most", "looks", "higher", "LOOKED_AT", "forgiven", "dispensable", "ask"),
    *("looked", "without", "match", "smooth", "votes", "judge", "mend", "bring", "undo", "undone"),
    *("moved", "_whole", "_trouble", "what_differs", "WholeFiles", "replaced", "claimed"),
    *("outlive_notice", "behind", "told", "hand_over", "_for_nothing", "keep_scene", "kept_scene"),
    *("measured", "bad_frames", "on_bad_frame", "BadFrames"),
    *("Settings", "Watch", "Progress", "Comparison", "Case"),
}
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
AT_MOST_ONCE = ["PosedScene", "SURE", "FARTHEST", "mean_color"]
# Maps names in the files of finished runs, so it has to contain them.
EXEMPT = "asysplat/training/old_names.py"


def defined_names(tree):
    """The functions, classes, arguments, variables and attributes that a module defines."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.arg():
                yield node.arg
            case ast.Name(ctx=ast.Store()):
                yield node.id
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr
            case ast.alias(asname=str()):
                yield node.asname


def keys(content):
    if isinstance(content, dict):
        for key, value in content.items():
            yield from str(key).split("@")[0].split("/")
            yield from keys(value)
    elif isinstance(content, list):
        for item in content:
            yield from keys(item)


@pytest.fixture(scope="module")
def places(repository):
    """Name -> the files that define it, of the package, the scripts and the configuration."""
    places = defaultdict(set)
    code = [*(repository / "asysplat").rglob("*.py"), *repository.glob("*.py")]
    settings = [*(repository / "conf").rglob("*.yaml"), *(repository / "sweeps").rglob("*.yaml")]
    for path in (*code, *settings):
        file = path.relative_to(repository)
        if file.as_posix() == EXEMPT:
            continue
        is_code = path.suffix == ".py"
        content = path.read_text()
        names = defined_names(ast.parse(content)) if is_code else keys(yaml.safe_load(content))
        for name in (*names, path.stem, *file.parent.parts):
            places[name].add(file.as_posix())
    assert len(places) > 3000
    return places


def test_replaced_names_are_gone(places):
    assert {name: sorted(places[name]) for name in REPLACED if name in places} == {}
    files = {file.rpartition("/")[2] for files in places.values() for file in files}
    assert not files & {"begin.py", "suite.py"}


def test_spelling_is_american(places):
    british = [name for name in places if any(part in name.lower() for part in BRITISH)]
    assert {name: sorted(places[name]) for name in british} == {}


@pytest.mark.parametrize("name", AT_MOST_ONCE)
def test_a_name_has_one_meaning(places, name):
    assert len(places.get(name, ())) <= 1, sorted(places[name])
