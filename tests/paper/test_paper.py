"""Every number of paper.yaml against the paper's source."""

import re

import pytest

from asysplat.errors import InputError
from paper.tables import (
    PaperRow,
    PaperTable,
    find_tables,
    load_claims,
    load_paper,
    our_sets,
    set_titles,
)

# What the cells before a row's numbers are, where it is more than the name.
LEADING = {
    "training_overhead": ("size", "name"),
    "state_of_the_art": ("name", "post_optimization"),
    "replica": ("name", "post_optimization"),
    "inference_overhead": ("size", "name"),
    "more_views": ("name", "views", "poses"),
    "mamba_ratio": ("mamba", "attention", "name"),
}
SUFFIXES = {"": 1, "s": 1, "min": 60, "G": 1, "k": 1e3, "M": 1e6}
# What a number is worth where the paper's header says so: TFLOPs, Param (M).
HEADER_UNITS = {
    ("inference_overhead", "gflops"): 1e3,
    ("more_views", "parameters"): 1e6,
    ("mamba_ratio", "parameters"): 1e6,
}


@pytest.fixture(scope="module")
def tabulars(shared) -> list[list[list[str]]]:
    """The cells of the paper's tables, as plain text."""
    source = shared / "paper" / "asysplat.tex"
    if not source.is_file():
        pytest.skip(f"{source} is absent")
    return [
        read_rows(body)
        for body in re.findall(r"\\midrule(.*?)\\bottomrule", source.read_text(), re.DOTALL)
    ]


def read_rows(body: str) -> list[list[str]]:
    """The cells of a tabular's lines; a cell that spans several rows stands in each."""
    lines = [line for line in re.sub(r"\\midrule|\[0.5pt\]", "", body).split(r"\\") if line.strip()]
    rows = [line.split("&") for line in lines]
    for i, cells in enumerate(rows):
        for j, cell in enumerate(cells):
            if span := re.search(r"\\multirow{(\d+)}{\*}(.*)", cell, re.DOTALL):
                for below in rows[i : i + int(span[1])]:
                    below[j] = span[2]
    return [[plain(cell) for cell in cells] for cells in rows]


def plain(cell: str) -> str:
    cell = re.sub(r"\\(cellcolor|cite){.*?}|\(Ours\)", "", cell)
    cell = cell.replace(r"\textless{}", "<").replace(r"\textgreater{}", ">")
    return re.sub(r"\\textbf|[{}$^~\\]", "", cell).strip()


def read_number(cell: str, unit: float) -> tuple[str, float] | None:
    """("<", ">" or "=", value); None for an empty cell or a dash."""
    if cell in ("", "-"):
        return None
    relation, digits, suffix = re.fullmatch(r"([<>]?)([\d.]+)([a-zA-Z]*)", cell).groups()
    return relation or "=", round(float(digits) * SUFFIXES[suffix] * unit, 6)


def recorded(row: PaperRow, key: str) -> tuple[str, float] | None:
    if key in row.numbers:
        return "=", row.numbers[key]
    return (row.bounds[key][0], float(row.bounds[key][1:])) if key in row.bounds else None


def check_row(table: PaperTable, row: PaperRow, cells: list[str]) -> None:
    leading = LEADING.get(table.key, ("name",))
    cell = dict(zip(leading, cells, strict=False))
    assert cell["name"] in row.name
    if "views" in cell:
        assert int(cell["views"]) == row.views
    if "post_optimization" in cell:
        assert read_number(cell["post_optimization"], 1) in (("=", row.post_optimization), None)
    printed = [column.key for column in table.columns if column.key != "train_hours"]
    numbers = dict(zip(printed, cells[len(leading) :], strict=True))
    printed = {k: read_number(v, HEADER_UNITS.get((table.key, k), 1)) for k, v in numbers.items()}
    assert printed == {key: recorded(row, key) for key in numbers}


def test_every_number_is_the_papers(tabulars):
    tables = load_paper().values()
    for table, rows in zip(tables, tabulars, strict=True):
        assert len(rows) == len(table.rows)
        for row, cells in zip(table.rows, rows, strict=True):
            check_row(table, row, cells)


def test_every_claim_is_the_papers(shared):
    source = shared / "paper" / "asysplat.tex"
    if not source.is_file():
        pytest.skip(f"{source} is absent")
    text = re.sub(r"[$\\]", "", source.read_text().replace(r"$\times$", "x"))
    claims = load_claims().claims
    assert all(claim.text in text for claim in claims if claim.stated)
    assert sum(claim.stated for claim in claims) == 16


def test_hours_of_a_stage_are_its_steps():
    rows = {row.name: row.numbers for row in load_paper()["training_overhead"].rows}
    assert rows["LongLRM, 256x256"]["train_hours"] == 60000 * 2.7 / 3600
    assert rows["AsySplat, 540x960"]["train_hours"] == 10000 * 6.0 / 3600


def test_rows_of_a_table_have_their_own_names_and_runs():
    for table in load_paper().values():
        assert len({row.name for row in table.rows}) == len(table.rows)
        ours = [row for row in table.rows if not row.quoted]
        # What tells two rows of one run apart, beside their sizes, is what is tested.
        tested = {(row.run, row.size, row.post_optimization, row.test_set) for row in ours}
        assert len(tested) == len(ours)
        assert table.rank_by is None or all(table.rank_by in row.numbers for row in table.rows)
        assert table.base in (None, *(row.name for row in ours))
    bases = {table.key: table.base for table in load_paper().values() if table.base}
    assert bases.keys() >= {"architecture", "layers", "asymmetry", "geometry_ratio"}


def test_unverified_rows_have_another_reading():
    rows = [row for table in load_paper().values() for row in table.rows]
    unverified = [row for row in rows if row.unverified]
    assert unverified == [row for row in rows if row.readings]
    assert all(run[0] == row.run[0] for row in unverified for run in row.readings.values())


def test_a_table_is_found_by_its_name():
    assert [table.number for table in find_tables("layers,mamba_ratio")] == ["6b", "A2"]
    assert len(find_tables("all")) == 13
    with pytest.raises(InputError, match=r"table=layer is unknown: did you mean layers"):
        find_tables("layer")


def test_our_set_beside_each_of_the_papers():
    tables = load_paper()
    ours = our_sets(tables["mamba_ratio"], "procedural", ["rooms", "outdoors", "mipnerf360"])
    assert ours == {"dl3dv": "procedural", "mipnerf360": "outdoors", "scannetpp": "rooms"}
    assert our_sets(tables["replica"], "procedural", ["rooms", "replica"]) == {"replica": "rooms"}
    ours = our_sets(tables["geometry_ratio"], "files", ["mipnerf360", "scannetpp"])
    assert ours == {"dl3dv": "files", "mipnerf360": "mipnerf360"}
    assert our_sets(tables["replica"], "dl3dv", ["replica"]) == {"replica": "replica"}


def test_every_set_of_the_paper_is_a_test_set_and_a_data_set(repository):
    for group in ("test_sets", "data"):
        files = {path.stem for path in (repository / "conf" / group).glob("*.yaml")}
        assert set(set_titles()) <= files
