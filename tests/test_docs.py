"""Documents name existing files, and generated figures and tables are up to date."""

import re
import runpy
import subprocess
import sys

import pytest

import asysplat
from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms

PAGES = ("api", "architecture", "benchmarks", "options", "questions", "scaling", "tables")
DOCUMENTS = ["README.md", "CONTRIBUTING.md", "examples/README.md", "data/README.md"]
DOCUMENTS += [f"docs/{page}.md" for page in PAGES]
PUBLIC = {name: getattr(asysplat, name).__module__ for name in asysplat.LATER}
WORD = r"(?<![\w/-])\w+(?![\w/-]|\.zip)"
SOURCES = (".py", ".yaml", ".json")
PLACES = r"`((?:asysplat|conf|sweeps|tests|docs|examples|data)/[\w./-]*)`"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_named_files_exist(repository, document):
    text = (repository / document).read_text()
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[\w-]*)?\)", text)
    folder = (repository / document).parent
    assert [link for link in links if not (folder / link).exists()] == []
    places = re.findall(PLACES, text)
    assert [place for place in places if not (repository / place).exists()] == []
    assert links or places


def test_named_functions_and_options_exist(repository):
    """Words in code font with an underscore or a capital within, anywhere but in a path."""
    folders = ("asysplat", "benchmarks", "conf", "docs", "examples", "paper", "tests")
    files = [f for name in folders for f in (repository / name).rglob("*") if f.suffix in SOURCES]
    files += [repository / "pyproject.toml", *repository.glob("*.py")]
    known = {word for file in files for word in re.findall(r"\w+", file.read_text() + file.stem)}
    for document in DOCUMENTS:
        code = re.findall(r"`[^`\n]*`", (repository / document).read_text())
        words = {word for text in code for word in re.findall(WORD, text)}
        names = {word for word in words if re.search(r"\w_\w|[a-z][A-Z]", word)}
        assert names <= known, (document, names - known)


@pytest.mark.medium
def test_the_architecture_figure_is_up_to_date(repository):
    drawn = runpy.run_path(str(repository / "docs" / "architecture.py"))["draw"]()
    assert (repository / "docs" / "architecture.svg").read_text() == drawn, (
        "run python docs/architecture.py"
    )


@pytest.mark.medium
def test_photographs_reach_the_scene_by_a_short_way(repository, tmp_path):
    scene = ProceduralScene(seed=7, height=32, width=32, num_images=10)
    write_transforms(scene.views(range(10)), tmp_path / "scene")
    options = ["steps=4", "video.path=none", f"paths.run={tmp_path / 'run'}"]
    command = [sys.executable, repository / "docs" / "walk.py", "reconstruct"]
    done = subprocess.run([*command, tmp_path / "scene", *options], capture_output=True, text=True)
    lines = [line.split() for line in done.stdout.splitlines()]
    entered = {words[1]: int(words[0]) for words in lines if words[:1] and words[0].isdigit()}
    assert entered["scene.py"] == 1, done.stderr
    assert entered["export/formats/ply.py"] <= 18, done.stdout


@pytest.mark.slow
def test_the_site_is_built_without_warnings(repository, tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "api" / "index.html").read_text()
    assert all(f'id="{place}.{name}"' in page for name, place in PUBLIC.items())
    assert "Render every view" in (tmp_path / "search" / "search_index.json").read_text()


def test_the_scaling_tables_match_their_results(repository):
    page = (repository / "docs" / "scaling.md").read_text()
    made = runpy.run_path(str(repository / "docs" / "scaling.py"))
    assert made["filled"](page) == page, "run python docs/scaling.py"
    assert all(f"<!-- {name} -->" in page for name in made["tables"]())


VERDICTS = ("as the paper", "assumed", "ours", "not here")


def test_every_statement_of_the_paper_has_a_verdict(repository):
    text = (repository / "docs" / "tables.md").read_text()
    listed = text.split("## The paper, statement by statement")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in listed.splitlines() if line.startswith("| ")]
    rows = [row for row in rows if row[0].strip() != "the paper"]
    assert len(rows) > 50
    for statement, _, verdict in rows:
        assert verdict.strip().startswith(VERDICTS), statement
    assert all(any(verdict in row[2] for row in rows) for verdict in VERDICTS)
