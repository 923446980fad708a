import math
from dataclasses import replace

import pytest

from paper.cells import make_section
from paper.compare import (
    check_costs,
    claim_value,
    fits,
    paired_difference,
    pooled_std,
    rank_agreement,
)
from paper.grid import Cell
from paper.tables import Claim, Column, PaperRow, PaperTable

PSNR = Column("dl3dv/psnr", "PSNR", "higher", "{:.2f}")


def row(name: str = "row", run: tuple[str, ...] | None = ("model=x",), **paper: float) -> PaperRow:
    paper = {"dl3dv/psnr" if key == "psnr" else key: value for key, value in paper.items()}
    return PaperRow(name, paper, run, 32, (256, 256))


def filled(paper: list[float], ours: list[list[float]]) -> PaperTable:
    rows = tuple(
        replace(row(psnr=number), values={"dl3dv/psnr": values} if values else {})
        for number, values in zip(paper, ours, strict=True)
    )
    return PaperTable("t", "1", "title", "protocol", (PSNR,), rows, "dl3dv/psnr")


def test_pooled_std_weighs_by_degrees_of_freedom():
    # Squares within: 2 of 1 degree, 2 of 2 degrees, none of a single seed.
    assert pooled_std([[0.0, 2.0], [4.0, 5.0, 6.0], [9.0]]) == pytest.approx(math.sqrt(4 / 3))
    assert pooled_std([[1.0], [2.0]]) is None


def test_rank_agreement_takes_the_rows_that_have_both():
    table = filled([19.0, 18.0, 17.0, 16.0], [[20.0, 22.0], [18.0, 20.0], [], [16.0, 18.0]])
    agreement = rank_agreement(table, "dl3dv/psnr")
    assert (agreement.rho, agreement.rows) == (pytest.approx(1.0), 3)
    # Means 21, 19, 17: 2 between the rows; sqrt(2) between seeds, 1 between means of two.
    assert agreement.signal == pytest.approx(2.0)


def test_rank_agreement_of_one_seed_has_no_signal():
    table = filled([3.0, 2.0, 1.0], [[1.0], [2.0], [3.0]])
    assert rank_agreement(table, "dl3dv/psnr").rho == pytest.approx(-1.0)
    assert rank_agreement(table, "dl3dv/psnr").signal is None
    assert rank_agreement(filled([1.0], [[]]), "dl3dv/psnr").rows == 0


def seeded(name: str, seeds: tuple[int, ...], psnr: list[float]) -> PaperRow:
    return replace(row(name, psnr=20.0), seeds=seeds, values={"dl3dv/psnr": psnr})


def test_differences_are_paired_by_seed():
    base = seeded("base", (0, 1, 2, 5), [20.0, 25.0, 15.0, 99.0])
    better = seeded("better", (0, 1, 2), [20.4, 25.5, 15.6])
    mean, half = paired_difference(better, base, "dl3dv/psnr")
    # Rows spread by 5 dB and their differences by 0.1: t of two degrees of freedom is 4.303.
    assert mean == pytest.approx(0.5) and half == pytest.approx(
        4.303 * 0.1 / math.sqrt(3), rel=1e-3
    )
    assert paired_difference(seeded("one", (1,), [24.0]), base, "dl3dv/psnr") == (-1.0, None)
    assert paired_difference(seeded("other", (7,), [24.0]), base, "dl3dv/psnr") is None
    assert paired_difference(better, base, "dl3dv/ssim") is None
    # A list that is shorter than its seeds cannot be paired.
    assert paired_difference(seeded("short", (0, 1, 2), [20.4, 25.5]), base, "dl3dv/psnr") is None


def test_a_table_shows_which_rows_differ_more_than_seeds():
    rows = (
        seeded("base", (0, 1, 2), [20.0, 25.0, 15.0]),
        seeded("clear", (0, 1, 2), [20.4, 25.5, 15.6]),
        seeded("unclear", (0, 1, 2), [20.6, 24.5, 15.1]),
        seeded("one seed", (1,), [24.0]),
    )
    table = PaperTable("t", "1", "title", "protocol", (PSNR,), rows, base="base")
    grid = make_section(table).grids[1]
    assert grid.caption.startswith("Differences to base, paired by seed")
    cells = {name.text: cell for name, cell in grid.rows}
    assert cells["clear"] == Cell("+0.50 ± 0.25", "best")
    assert cells["unclear"] == Cell("+0.07 ± 1.37", "")
    assert cells["one seed"] == Cell("-1.00", "muted")
    assert len(make_section(replace(table, base=None)).grids) == 1


def test_a_claim_compares_the_sums_of_its_sides():
    def claim(form, first, second):
        sides = tuple(tuple(row(psnr=n) for n in side) for side in (first, second))
        return Claim("words", True, form, "table", PSNR, sides)

    def number(row):
        return row.numbers["dl3dv/psnr"]

    assert claim_value(claim("reduction", [1.0, 2.0], [4.0, 2.0]), number) == 0.5
    assert claim_value(claim("speedup", [2.0], [6.0]), number) == 3
    assert claim_value(claim("gain", [2.5], [2.0]), number) == 0.5
    assert claim_value(claim("total", [2.0, 3.0], []), number) == 5
    assert claim_value(claim("speedup", [2.0], [6.0]), lambda row: None) is None


def test_limits_of_a_fit():
    paper = row(parameters=100e6, gflops=2000.0)
    assert fits(paper, {"parameters": 101.4e6, "gflops": 2058.0})
    assert not fits(paper, {"parameters": 101.6e6, "gflops": 2000.0})
    assert not fits(paper, {"parameters": 100e6, "gflops": 1938.0})


def test_costs_near_the_paper_s_fit():
    paper = row(parameters=100e6)
    good, bad = {"parameters": 101e6}, {"parameters": 110e6}
    unverified = replace(paper, unverified="no layers are named")
    assert check_costs(replace(paper, costs=good)) == "fits"
    assert check_costs(replace(paper, costs=bad)) == "off"
    assert check_costs(replace(unverified, costs=good)) == "unverified, fits"
    assert check_costs(replace(unverified, costs=bad)) == "unverified, no fit"
    assert check_costs(row(run=None, parameters=1e6)) == "quoted"
    assert check_costs(paper) == "not computed"
    assert check_costs(replace(row(psnr=19.0), costs=good)) == "not printed"
