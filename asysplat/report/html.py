"""Filled tables as one HTML page that needs nothing else: no network, no script."""

from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from asysplat.report.filled import FilledTable
from asysplat.report.layout import INTRODUCTION, TITLE, make_overview, make_sheet
from asysplat.report.plots import make_plots
from asysplat.report.svg import inline_svg

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render_html(tables: Sequence[FilledTable]) -> str:
    """The page: an overview that links to a section for each table, with its plots inside."""
    sections = [(make_sheet(filled), _plots(filled)) for filled in tables]
    return TEMPLATES.get_template("page.html.jinja").render(
        title=TITLE,
        introduction=INTRODUCTION,
        overview=make_overview(tables),
        sections=sections,
    )


def _plots(filled: FilledTable) -> list[tuple[str, Markup]]:
    """Caption and drawing of each plot."""
    return [
        (caption, Markup(inline_svg(figure, f"{filled.table.key}-{number}")))
        for number, (caption, figure) in enumerate(make_plots(filled))
    ]
