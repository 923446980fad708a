import re
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from asysplat.evaluation.metrics import write_csv
from paper.fill import COMPUTED
from paper.html import render_html
from paper.markdown import escape, render_markdown
from paper.plots import make_plots
from paper.tables import Column, PaperRow, PaperTable, load_paper
from paper.terminal import render_terminal

COLUMNS = (
    Column("parameters", "Param (M)", None, "{:.1f}", 1e6),
    Column("inference_seconds", "Time (s)", "lower", "{:.2f}"),
    Column("dl3dv/psnr", "PSNR", "higher", "{:.2f}"),
    Column("dl3dv/lpips", "LPIPS", "lower", "{:.3f}"),
)


def make_row(name: str, run: tuple[str, ...] | None = ("model=x",), **fields) -> PaperRow:
    keys = {"psnr": "dl3dv/psnr", "lpips": "dl3dv/lpips"} | {c.key: c.key for c in COLUMNS}
    paper = {keys[key]: float(fields.pop(key)) for key in list(fields) if key in keys}
    readings = {"without the links": ("model=y",)} if "unverified" in fields else {}
    return PaperRow(name, paper, run, 32, (256, 256), readings=readings, **fields)


def costs(parameters: float) -> dict[str, int | float]:
    return {
        "parameters": int(parameters),
        "geometry_ratio": 0.905,
        "gflops": 2041.2,
        "gflops_true": 2600.4,
        "gaussians": 524288,
        "activation_gb": 21.34,
    }


def values(*psnr: float, seconds: float = 0.2) -> dict[str, list[int | float]]:
    count = len(psnr)
    return {
        "dl3dv/psnr": list(psnr),
        "dl3dv/lpips": [0.5] * count,
        "inference_seconds": [seconds] * count,
    }


def make_table(key: str, number: str, title: str, columns: tuple[Column, ...], rows, **notes):
    return PaperTable(key, number, title, "32 views", columns, tuple(rows), "dl3dv/psnr", **notes)


@pytest.fixture
def table() -> PaperTable:
    open_row = {"unverified": "No layers are named.", "reading_costs": (costs(89.1e6),)}
    ours = {"values": values(21.0, 22.0, 23.0), "seeds": (0, 1, 2), "costs": costs(98.11e6)}
    off = {"values": values(20.5, 20.7, seconds=0.1), "seeds": (0, 1), "costs": costs(91e6)}
    off |= {"inference_seconds": 0.3, "note": "2 of 3 seeds"}
    open_row |= {"values": values(21.5), "seeds": (0,), "costs": costs(93e6)}
    quick = {"inference_seconds": "<1"}
    differing = ("width=1 (0.5)", "steps=8 (7)", "data.inputs=4 (8)", "seed=*", "training.a=<b>")
    later = {"note": "not run: logs/one has other options", "options": differing}
    rows = (
        make_row("Quoted|net", None, parameters=125e6, psnr=25.89, lpips=0.142),
        make_row("Net*", parameters=98e6, psnr=19.24, lpips=0.49, bounds=quick, **ours),
        make_row("Off", parameters=88e6, psnr=18.74, lpips=0.52, **off),
        make_row("Open", parameters=89e6, psnr=19.1, **open_row),
        make_row("Later", parameters=95e6, psnr=17.78, costs=costs(95e6), **later),
    )
    notes = {"Ours": "laptop: 8 views of 64x64", "Machine": "2 cores"}
    notes["Command"] = "python train.py sweeps=layers"
    metrics = ("protocol longlrm. PSNR: mean of *all* images",)
    made = {"sets": {"dl3dv": "my_rooms"}, "metrics": metrics, "notes": notes}
    return make_table("layers", "6b", "Layers <of> a stage", COLUMNS, rows, **made)


@pytest.fixture
def ratios(table) -> PaperTable:
    """A table of one ratio, all of it run."""
    rows = [
        make_row(f"{share}%", psnr=psnr, values=values(*seeds), seeds=(0, 1))
        for share, psnr, *seeds in [(90, 19.2, 21, 22), (80, 19.1, 21, 20), (70, 19.0, 19, 20)]
    ]
    return make_table("geometry_ratio", "A3", "Share", COLUMNS[2:3], rows)


class Page(HTMLParser):
    """Checks that elements close in order; collects texts, ids, links and tags."""

    VOID = ("meta", "link")
    TEXT = ("td", "th", "dt", "dd", "h2", "figcaption", "summary", "p")

    def __init__(self, text: str):
        super().__init__()
        self.open, self.ids, self.links, self.tags = [], set(), set(), set()
        self.cells: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.add(tag)
        self.ids.add(attrs.get("id"))
        if tag == "a":
            self.links.add(attrs["href"])
        if tag not in self.VOID:
            self.open.append(tag)
        if tag in self.TEXT:
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if set(self.TEXT) & set(self.open):
            self.cells[-1] += data


def on_terminal(table: PaperTable, width: int) -> str:
    console = Console(width=width, file=StringIO())
    render_terminal([table], console)
    return console.file.getvalue()


def line(markdown: str, start: str, nth: int = 0) -> list[str]:
    """Cells of the nth line of a Markdown table that begins with `start`."""
    found = [text for text in markdown.splitlines() if text.startswith(f"| {start} |")]
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", found[nth])[2:-1]]


def test_cells_of_every_kind_of_row(table):
    text = render_markdown([table])
    assert line(text, "Net\\*") == [
        "\\<1", "0.20 ± 0.00", "19.24", "**22.00 ± 1.00**", "0.490", "0.500 ± 0.000",
    ]  # fmt: skip
    assert line(text, r"Quoted\|net")[2:4] == ["**25.89**", "quoted"]
    assert line(text, "Off")[:4] == ["0.30", "**0.10 ± 0.00**", "18.74", "20.60 ± 0.14"]
    assert line(text, "Open †")[2:5] == ["19.10", "21.50", "-"]
    assert line(text, "Later") == ["-", "not run", "17.78", "not run", "-", "not run"]


def test_costs_beside_the_paper(table):
    text = render_markdown([table])
    # Param: paper, ours, error; module GFLOPs, true ones, Gaussians, share, activations; check.
    rest = ["2,041", "2,600", "0.524", "90.5", "21.3"]
    assert line(text, "Net\\*", 1) == ["98", "98.11", "+0.1%", *rest, "fits"]
    assert line(text, "Open †", 1) == ["89", "93", "**+4.5%**", *rest, "unverified, no fit"]
    assert line(text, "or: without the links") == ["89", "89.1", "+0.1%", *rest, "fits"]
    assert line(text, "Quoted\\|net", 1) == ["125", *["-"] * 7, "quoted"]


def test_notes_under_a_table(table):
    text = render_markdown([table])
    for note in (
        "**Substitutes**: DL3DV-140 by our test set my\\_rooms",
        "**Seeds**: 0, 1, 2: mean ± sample standard deviation over them",
        # Means 22, 20.6, 21.5: 0.71 between rows; sqrt((2 + 0.02) / 3) = 0.82 between seeds,
        # of which there are two a row on average.
        "Spearman's rho of our my\\_rooms PSNR with the paper's DL3DV-140 PSNR is 1.00 over 3 "
        "rows; rows differ 1.2 x as much as seeds alone make them: the order means little",
        "**Quoted**: Quoted\\|net",
        "**Not run**: Later: logs/one has other options: width=1 (0.5), steps=8 (7), data.inputs=4",
        "**Command**: `python train.py sweeps=layers`",
    ):
        assert note in text


@pytest.mark.medium
def test_our_numbers_have_the_name_of_our_test_set(table, ratios):
    """In every renderer: ours under my_rooms, the paper's under DL3DV-140."""
    ratios = replace(ratios, sets=table.sets)
    markdown = render_markdown([table])
    assert (
        "| DL3DV-140 PSNR ↑ paper | my\\_rooms PSNR ↑ ours |".replace(" ↑", "\u00a0↑") in markdown
    )
    texts = [markdown, on_terminal(table, 300), *Page(render_html([table])).cells]
    assert not any(re.search(r"DL3DV-140 (PSNR|LPIPS)[^|]{0,4}ours", text) for text in texts)
    headings = [text for text in texts if re.fullmatch(r"\S+ (PSNR|LPIPS).*", text)]
    assert headings == [
        f"{name} {kind}\u00a0{arrow}"
        for kind, arrow in (("PSNR", "↑"), ("LPIPS", "↓"))
        for name in ("DL3DV-140", "my_rooms")
    ]
    for filled in (table, ratios):
        for caption, figure in make_plots(filled):
            ours, paper = figure.axes
            labels = [f"{axes.get_xlabel()} {axes.get_ylabel()}" for axes in (ours, paper)]
            assert "my_rooms PSNR" in labels[0] and "DL3DV-140 PSNR" in labels[1]
            assert "DL3DV" not in labels[0] + caption and "my_rooms" not in labels[1]


def test_a_table_of_ours_has_no_columns_of_the_paper(table):
    columns = [column.key for column in table.columns]
    rows = tuple(replace(row, numbers={}, bounds={}) for row in table.rows)
    ours = replace(table, number=None, protocol="", rank_by=None, rows=rows)
    text = render_markdown([ours])
    assert text.count("## Ours: ") == 1 and "paper |" not in text and "Substitutes" not in text
    measured = [column for column in columns if column not in COMPUTED]
    assert len(line(text, "Net\\*")) == len(measured)


@pytest.mark.medium
def test_html_has_the_texts_of_markdown(table, ratios):
    markdown = render_markdown([table, ratios])
    page = Page(render_html([table, ratios]))
    plots = [caption for table in (table, ratios) for caption, _ in make_plots(table)]
    words = [text for text in page.cells if text not in plots]
    assert len(words) > 150
    assert [text for text in words if escape(text) not in markdown and text not in markdown] == []


@pytest.mark.medium
def test_html_needs_nothing_else(table, ratios):
    text = render_html([table, ratios])
    page = Page(text)
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    assert "script" not in page.tags
    assert page.links == {"#table-6b-layers-of-a-stage", "#table-a3-share"}
    assert {link[1:] for link in page.links} <= page.ids
    assert "Layers &lt;of&gt; a stage" in text and "details" in page.tags
    assert text == render_html([table, ratios])


def test_a_narrow_terminal_has_all_of_a_wide_table(table):
    wide, narrow = (on_terminal(table, width) for width in (200, 80))
    assert "22.00 ± 1.00" in wide and "unverified, no fit" in wide
    tables = [narrow.split("Paper: 32")[0] for narrow in (narrow, on_terminal(table, 60))]
    for text, width in zip(tables, (80, 60), strict=True):
        assert max(map(len, text.splitlines())) <= width
        for line in wide.split("Paper: 32")[0].splitlines():
            cells = [cell.strip() for cell in line.split("│")[2:-1]]  # of numbers
            assert [cell for cell in cells if cell not in text] == []
    assert "…" not in "".join(tables)


def test_plots_show_every_seed_and_the_paper(table, ratios):
    (_, seeds), *_ = make_plots(table)
    ours, paper = seeds.axes
    drawn = sorted(x for dots in ours.lines for x in dots.get_xdata() if dots.get_marker() == "o")
    assert drawn == [20.5, 20.7, 21.0, 21.5, 22.0, 23.0]
    assert [text.get_text() for text in ours.texts] == ["quoted", "not run"]
    assert [bar.get_xdata()[0] for bar in paper.lines] == [25.89, 19.24, 18.74, 19.1, 17.78]
    [(_, lines)] = make_plots(ratios)
    ours, paper = lines.axes
    assert list(paper.lines[0].get_xdata()) == [90, 80, 70]
    assert list(paper.lines[0].get_ydata()) == [19.2, 19.1, 19.0]
    [mean] = [
        line for line in ours.lines if len(line.get_xdata()) == 3 and line.get_marker() == "o"
    ]
    assert list(mean.get_ydata()) == [21.5, 20.5, 19.5]


def test_images_are_plotted_where_depths_are_measured(tmp_path):
    """As the paper's Figure 1: a dot for each image of our set, a color for each row."""
    rows = ({"set": s, "absrel": a, "psnr": 20 + a} for s in ("rooms", "other") for a in (0.2, 0.4))
    write_csv(tmp_path / "metrics.csv", list(rows))
    table = load_paper()["asymmetry"]
    first, second, last = table.rows
    run = {"values": {"dl3dv/psnr": [20.0]}, "seeds": (0,), "folders": (str(tmp_path),)}
    rows = (replace(first, **run), replace(second, **run), last)
    table = replace(table, rows=rows, sets={"dl3dv": "procedural", "scannetpp": "rooms"})
    *_, (caption, figure) = make_plots(table)
    (axes,) = figure.axes
    assert "rooms" in caption and axes.get_xlabel() == "rooms AbsRel ↓"
    dots, mean, *others = axes.lines
    assert dots.get_xdata().tolist() == [0.2, 0.4] and dots.get_ydata().tolist() == [20.2, 20.4]
    assert np.allclose([*mean.get_xdata(), *mean.get_ydata()], [0.3, 20.3])
    assert mean.get_color() == dots.get_color() != others[0].get_color()
    assert [text.get_text() for text in axes.get_legend().texts] == [first.label, second.label]
