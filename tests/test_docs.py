"""Documents name what is there, and the picture of the code is that of the code."""

import re
import runpy

import pytest

DOCUMENTS = ["README.md", "CONTRIBUTING.md", "docs/architecture.md", "docs/tables.md"]
DOCUMENTS += [
    "docs/questions.md",
    "docs/benchmarks.md",
    "docs/scaling.md",
    "examples/README.md",
    "data/README.md",
]
PLACES = r"`((?:asysplat|conf|sweeps|tests|docs|examples|data)/[\w./-]*)`"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_file_it_names_is_there(repository, document):
    text = (repository / document).read_text()
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[\w-]*)?\)", text)
    folder = (repository / document).parent
    assert [link for link in links if not (folder / link).exists()] == []
    places = re.findall(PLACES, text)
    assert [place for place in places if not (repository / place).exists()] == []
    assert links or places


def test_the_picture_of_the_architecture_is_up_to_date(repository):
    drawn = runpy.run_path(str(repository / "docs" / "architecture.py"))["draw"]()
    assert (repository / "docs" / "architecture.svg").read_text() == drawn, (
        "run python docs/architecture.py"
    )


def test_the_tables_of_scaling_are_those_of_the_results(repository):
    page = (repository / "docs" / "scaling.md").read_text()
    made = runpy.run_path(str(repository / "docs" / "scaling.py"))
    assert made["filled"](page) == page, "run python docs/scaling.py"
    assert all(f"<!-- {name} -->" in page for name in made["tables"]())
