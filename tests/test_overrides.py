"""An override must name what exists; otherwise one sentence names the nearest that does."""

import itertools
import re
import shlex
import sys

import pytest
from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from asysplat import overrides
from asysplat.cli import check_command
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.root import CONF

KNOWN = [
    [],
    ["model=asysplat_4m4s", "scale=paper", "steps=5", "model.layers=7m1t"],
    ["model=longlrm,asysplat_4m4s", "seed=0,1,2", "learning_rate=choice(1e-3,1e-4)"],
    ["sweeps=layers", "hydra/launcher=joblib", "hydra.run.dir=x", "model=asysplat_7m1s"],
    ["model/links=both", "~callbacks.costs", "trainer=cpu", "trainer.devices=2"],
    ["~callbacks", "seed=range(3)", "model=glob(asysplat_*)"],
    ["+data.test_sets.more_views.inputs=16", "data.test_sets.more_views.inputs=8", "++new=1"],
]


@pytest.mark.parametrize("known", KNOWN, ids=" ".join)
def test_known_overrides_are_taken_in_any_folder(known, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_overrides(known)


UNKNOWN = {
    "widht=0.5": "Could not override 'widht': did you mean width?",
    "data.inptus=4": "Could not override 'data.inptus': did you mean data.inputs?",
    "stage=stage1,stage4": "stage=stage4 is unknown: choose from stage1, stage2, stage3, ablation.",
    "~callbacks.cots": "'callbacks.cots' does not exist: did you mean callbacks.costs?",
    "model=longlrm,asysplat_4m4z": "Could not find 'model/asysplat_4m4z': did you mean model/",
    "model/links=bth": "did you mean model/links/both?",
    "steps": "steps cannot be read: write option=value",
    "name=my (run": "needs quotes of its own",
}


@pytest.mark.medium
@pytest.mark.parametrize("override", UNKNOWN)
def test_an_unknown_override_names_the_nearest(override):
    with pytest.raises(InputError) as raised:
        check_overrides([override])
    assert UNKNOWN[override] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_options_of_the_other_scripts():
    for script, known, unknown, nearest in (
        ("report", "table=[layers,geometry_ratio] costs=true logs=elsewhere", "cots=true", "costs"),
        ("benchmark", "suite=ops ops.ssd.length=512 model.names=[longlrm]", "repeat=3", "repeats"),
        (
            "evaluate",
            "model=plane_sweep data=files data.root=x scale=gpu",
            "gausians=a.ply",
            "gaussians",
        ),
    ):
        check_overrides(known.split(), script)
        with pytest.raises(InputError, match=f"did you mean {nearest}"):
            check_overrides([unknown], script)


@pytest.mark.parametrize("name", ["my (scene)", "it's [1]", "0.5"])
def test_existing_paths_need_no_quotes_of_their_own(tmp_path, monkeypatch, name):
    (tmp_path / name).mkdir()
    monkeypatch.setattr("sys.argv", ["evaluate.py", f"run={tmp_path / name}", "width=0.5"])
    check_command("evaluate")
    run, width = map(overrides._parse, sys.argv[1:])
    assert run.value() == str(tmp_path / name) and width.value() == 0.5


COMMAND = re.compile(
    r"(?:python |asysplat )(train|evaluate|reconstruct|report|benchmark)(?:\.py)?"
    r"((?: [^\s#`:,;()]+(?:,[^\s`]+)*)*)"
)
IN_A_TABLE = re.compile(r"\| `([\w./]+=[^`]+)`")


def test_the_first_words_are_paths_until_an_option(tmp_path):
    odd = tmp_path / "a=b"
    assert overrides.split_paths(["shelf/one/", "two", "height=9", "x"]) == (
        ["shelf/one/", "two"],
        ["height=9", "x"],
    )
    assert overrides.split_paths([str(odd)])[0] == []
    odd.mkdir()
    assert overrides.split_paths([str(odd), "-m"]) == ([str(odd)], ["-m"])
    assert overrides.split_paths(["--help"]) == ([], ["--help"]) and overrides.split_paths([]) == (
        [],
        [],
    )


def printed_commands(repository) -> list[tuple[str, str]]:
    """List scripts and overrides in the documents and the comments under conf/."""
    folders = (".", "data", "docs", "examples", "sweeps")
    documents = [path for name in folders for path in sorted((repository / name).glob("*.md"))]
    texts = [path.read_text() for path in documents]
    found = {("train", overrides) for text in texts for overrides in IN_A_TABLE.findall(text)}
    for path in (repository / "conf").rglob("*.yaml"):
        texts += [line for line in path.read_text().splitlines() if line.startswith("# ")]
    for text in texts:
        found |= set(COMMAND.findall(text.replace("\\\n", " ")))
    return sorted(found)


@pytest.mark.medium
def test_every_printed_command_names_what_is_there(repository, request):
    printed = printed_commands(repository)
    assert printed
    GlobalHydra.instance().clear()
    request.addfinalizer(GlobalHydra.instance().clear)
    initialize_config_dir(str(CONF), version_base="1.3")  # once for all
    together: dict[tuple, dict[str, str]] = {}  # options of commands with the same choices
    for script, given in printed:
        words = shlex.split(given)
        if script == "reconstruct":  # its photographs
            words = [word for word in words if word not in ("my_scene", "shelf/*/")]
        options = {
            word.lstrip("+~").partition("=")[0]: word
            for word in get_args_parser().parse_args(words).overrides
        }
        choices = {word for key, word in options.items() if (CONF / key.split("@")[0]).is_dir()}
        for number in itertools.count():
            others = together.setdefault((script, *sorted(choices), number), {})
            if all(others.get(key, word) == word for key, word in options.items()):
                others.update(options)
                break
    for (script, *_), options in together.items():
        check_overrides(options.values(), script)


@pytest.mark.medium
@pytest.mark.parametrize("script", ["train", "reconstruct", "evaluate", "report", "benchmark"])
def test_help_is_a_page_of_options_that_exist(run_script, composed, script):
    lines = run_script(f"{script}.py", "--help").stdout.strip().splitlines()
    assert lines[0].startswith(f"python {script}.py ") and len(lines) < 20
    words = [line.split()[0].partition("=")[0] for line in lines[2:-2] if "=" in line.split(" ")[0]]
    assert len(words) >= 4
    config = composed(script=script)
    for word in words:
        known = OmegaConf.select(config, word, throw_on_missing=False, default=config)
        assert known is not config or (CONF / word).is_dir(), word
