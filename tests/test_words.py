"""What the words of a command name must be there; else the nearest that is, in one sentence."""

import re
import shlex
import subprocess
import sys

import pytest
from hydra._internal.utils import get_args_parser

from asysplat.errors import InputError
from asysplat.words import check_words

KNOWN = [
    [],
    ["model=asysplat_4m4s", "scale=paper", "steps=5", "model.layers=7m1t"],
    ["model=longlrm,asysplat_4m4s", "seed=0,1,2", "training.learning_rate=choice(1e-3,1e-4)"],
    ["sweeps=layers", "hydra/launcher=joblib", "hydra.run.dir=x", "model=asysplat_7m1s"],
    ["data=files", "data.root=my scenes/one", "data.cache.folder=null"],
    ["model/links=both", "~callbacks.costs", "trainer=cpu", "trainer.devices=2"],
    ["~callbacks", "seed=range(3)", "model=glob(asysplat_*)"],
    ["+data.test_sets.more_views.inputs=16", "data.test_sets.more_views.inputs=8", "++new=1"],
    ["+data.test_sets.more_views={inputs: 5, test_scenes: 2}"],
]


@pytest.mark.parametrize("words", KNOWN, ids=" ".join)
def test_words_that_are_known(words):
    check_words(words)


def test_tables_are_found_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_words(["sweeps=layers", "steps=1"])


UNKNOWN = {
    "widht=0.5": "widht is unknown: did you mean width?",
    "data.inptus=4": "data.inptus is unknown: did you mean data.inputs?",
    "training.learning_rte=1e-3": "did you mean training.learning_rate?",
    "learning_rate=1e-3": "did you mean training.learning_rate?",
    "batch_sizes=2,4": "did you mean data.batch_size?",
    "callbacks.pictres.scenes=1": "did you mean callbacks.pictures.scenes?",
    "~callbacks.cots": "callbacks.cots is unknown: did you mean callbacks.costs?",
    "data.root=my_scene": "data.root is unknown: it is an option of data=colmap, ",
    "qqq=1": "qqq is unknown: python train.py --cfg job shows all.",
    "model=longlrm,asysplat_4m4z": "model=asysplat_4m4z is unknown: did you mean asysplat_4m4",
    "model/links=bth": "did you mean both? All are in conf/model/links/.",
    "sweeps=layer": "did you mean layers, asymmetry? All are in sweeps/.",
    "steps": "steps sets nothing: write steps=value",
    "name=my (run": "needs quotes of its own",
}


@pytest.mark.parametrize("word", UNKNOWN)
def test_words_that_are_not(word):
    with pytest.raises(InputError) as raised:
        check_words([word])
    assert UNKNOWN[word] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_options_of_the_other_scripts():
    check_words(["table=[layers,geometry_ratio]", "costs=true", "logs=elsewhere"], "report")
    check_words(["suite=ops", "ops.ssd.length=512", "model.names=[longlrm]"], "benchmark")
    with pytest.raises(InputError, match="did you mean costs"):
        check_words(["cots=true"], "report")
    with pytest.raises(InputError, match="did you mean repeats"):
        check_words(["repeat=3"], "benchmark")


@pytest.mark.slow
def test_a_script_says_it_from_any_folder(repository, tmp_path):
    command = [sys.executable, repository / "report.py", "cots=true"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode != 0
    assert result.stderr == "error: cots is unknown: did you mean costs?\n"


COMMAND = re.compile(r"python (train|report|benchmark)\.py((?: [^\s#`:,;()]+(?:,[^\s`]+)*)*)")
IN_A_TABLE = re.compile(r"\| `([\w./]+=[^`]+)`")


def printed_commands(repository) -> list[tuple[str, str]]:
    """Scripts and words, as the READMEs and the comments under conf/ and sweeps/ have them."""
    texts = [(repository / name).read_text() for name in ("README.md", "data/README.md")]
    found = {("train", words) for words in IN_A_TABLE.findall(texts[0])}
    for folder in ("conf", "sweeps"):
        for path in (repository / folder).rglob("*.yaml"):
            texts += [line for line in path.read_text().splitlines() if line.startswith("# ")]
    for text in texts:
        found |= set(COMMAND.findall(text.replace("\\\n", " ")))
    return sorted(found)


@pytest.mark.slow
def test_every_printed_command_names_what_is_there(repository):
    printed = printed_commands(repository)
    assert len(printed) > 100
    for script, words in printed:
        check_words(get_args_parser().parse_args(shlex.split(words)).overrides, script)
