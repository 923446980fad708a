"""An override must name what exists; otherwise one sentence names the nearest that does."""

import re
import shlex
import subprocess
import sys
from functools import cache

import pytest
from hydra._internal.utils import get_args_parser
from omegaconf import OmegaConf

from asysplat import overrides
from asysplat.cli import check_command
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.root import CONF


@pytest.fixture(scope="module", autouse=True)
def compose_once():
    """Compose each choice of files once for all overrides."""
    compose = overrides._compose
    by_line = cache(lambda script, lines: compose(script, [overrides._parse(x) for x in lines]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            overrides,
            "_compose",
            lambda script, all: by_line(script, tuple(o.input_line for o in all)),
        )
        yield


KNOWN = [
    [],
    ["model=asysplat_4m4s", "scale=paper", "steps=5", "model.layers=7m1t"],
    ["model=longlrm,asysplat_4m4s", "seed=0,1,2", "learning_rate=choice(1e-3,1e-4)"],
    ["stage=stage2", "scale=gpu"],
    ["stage=stage1,stage2,stage3", "experiment=two_views"],
    ["sweeps=layers", "hydra/launcher=joblib", "hydra.run.dir=x", "model=asysplat_7m1s"],
    ["data=files", "data.root=my scenes/one", "data.cache.folder=null"],
    ["model/links=both", "~callbacks.costs", "trainer=cpu", "trainer.devices=2"],
    ["~callbacks", "seed=range(3)", "model=glob(asysplat_*)"],
    ["+data.test_sets.more_views.inputs=16", "data.test_sets.more_views.inputs=8", "++new=1"],
    ["+data.test_sets.more_views={inputs: 5, test_scenes: 2}"],
]


@pytest.mark.parametrize("known", KNOWN, ids=" ".join)
def test_known_overrides_are_taken_in_any_folder(known, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_overrides(known)


UNKNOWN = {
    "widht=0.5": "widht is unknown: did you mean width?",
    "data.inptus=4": "data.inptus is unknown: did you mean data.inputs?",
    "training.learning_rate=1e-3": "did you mean learning_rate?",
    "trainer.steps=5": "did you mean steps?",
    "learning_rte=1e-3": "did you mean learning_rate?",
    "weight_decay=0": "did you mean training.optimizer.weight_decay?",
    "stage=stage4": "stage=stage4 is unknown: choose stage1, stage2, stage3 or ablation.",
    "stage=stage1,stage4": "stage=stage4 is unknown: choose stage1, stage2, stage3 or ablation.",
    "experiment=stage1": "experiment=stage1 is unknown: did you mean",
    "batch_sizes=2,4": "did you mean data.batch_size?",
    "callbacks.pictres.scenes=1": "did you mean callbacks.figures.scenes?",
    "~callbacks.cots": "callbacks.cots is unknown: did you mean callbacks.costs?",
    "data.root=my_scene": "data.root is unknown: it is an option of data=deep_blending, ",
    "qqq=1": "qqq is unknown: python train.py --cfg job shows all.",
    "model=longlrm,asysplat_4m4z": "model=asysplat_4m4z is unknown: did you mean asysplat_4m4",
    "model/links=bth": "did you mean both? All are in conf/model/links/.",
    "sweeps=layer": "did you mean layers, asymmetry? All are in conf/sweeps/.",
    "model=asysplat_sweep": "did you mean asysplat_plane_sweep",
    "data=colmap": "did you mean deep_blending, disk, dl3dv, files, ",  # all of them
    "steps": "steps sets nothing: write steps=value",
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
            "run=logs/asysplat/one post_optimization_steps=[0,5] paths.logs=elsewhere",
            "gausians=a",
            "gaussians",
        ),
        (
            "evaluate",
            "init_path=shipped data=files data.root=x scale=gpu",
            "gausians=a.ply",
            "gaussians",
        ),
    ):
        check_overrides(known.split(), script)
        with pytest.raises(InputError, match=f"did you mean {nearest}"):
            check_overrides([unknown], script)


@pytest.mark.medium
def test_a_script_says_it_from_any_folder(repository, tmp_path):
    command = [sys.executable, repository / "report.py", "cots=true"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode != 0
    assert result.stderr == "error: cots is unknown: did you mean costs?\n"


DASHES = {
    "--quality best": "quality=best",
    "--steps=20": "steps=20",
    "name=a --learning-rate 1e-3": "learning_rate=1e-3",
    "--viewer": "viewer=true",
    "--viewer steps=20": "viewer=true",
}


@pytest.mark.parametrize("given", DASHES)
def test_options_with_dashes_are_answered_by_how_they_are_given(given, monkeypatch):
    monkeypatch.setattr("sys.argv", ["train.py", *given.split()])
    with pytest.raises(SystemExit, match=f": options are given as {DASHES[given]}\\.$"):
        check_command("train")


@pytest.mark.parametrize("name", ["0_model=longlrm", "my (scene)", "it's [1]", "plain", "0.5"])
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
def test_every_printed_command_names_what_is_there(repository):
    printed = printed_commands(repository)
    assert printed
    for script, given in printed:
        words = shlex.split(given)
        if script == "reconstruct":  # its photographs, and switches
            words = [word for word in words if word not in ("my_scene", "--view", "--open")]
        check_overrides(get_args_parser().parse_args(words).overrides, script)


def test_printed_commands_with_the_shipped_weights_have_their_model(repository):
    commands = [given for _, given in printed_commands(repository) if "init_path=shipped" in given]
    assert commands
    assert [given for given in commands if "model=asysplat_plane_sweep" not in given] == []


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
