"""Write filled tables as one HTML page without other files, network access or scripts."""

import io
import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from paper.cells import INTRODUCTION, TITLE, make_overview, make_section
from paper.plots import make_plots
from paper.style import FAINT, INK, OURS, PAPER, STYLE
from paper.tables import PaperTable

TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
# A plot's colors become the page's variables, so that a dark page has light ink.
VARIABLES = {INK: "--ink", FAINT: "--faint", OURS: "--ours", PAPER: "--paper"}


def render_html(tables: Sequence[PaperTable]) -> str:
    """Write the page: an overview that links to a section for each table, with its plots."""
    sections = []
    for filled in tables:
        plots = [
            (caption, Markup(inline_svg(figure, f"{filled.key}-{number}")))
            for number, (caption, figure) in enumerate(make_plots(filled))
        ]
        sections.append((make_section(filled), plots))
    return TEMPLATES.get_template("page.html.jinja").render(
        title=TITLE,
        introduction=INTRODUCTION,
        overview=make_overview(tables),
        sections=sections,
    )


def inline_svg(figure: Figure, salt: str) -> str:
    """Draw a figure as an `<svg>` element for a page; `salt` makes its ids unique."""
    buffer = io.StringIO()
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # The page declares the name spaces, and sets the font and the size.
    unused = r"""(?s)<metadata>.*?</metadata>| xmlns(:\w+)?="[^"]*"|font-family: [^;"]*;"""
    text = re.sub(unused, "", text)
    text = re.sub(r'<svg width="[^"]*" height="[^"]*"', "<svg", text)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var({variable})")
    return text
