"""The look of every plot, and how it becomes a part of an HTML page."""

import io
import re

import matplotlib
from matplotlib.figure import Figure

INK, FAINT, OURS, PAPER = "#101112", "#909192", "#1f6feb", "#c2570c"
# In a page the colours are the page's variables, so that a dark page has light ink.
VARIABLES = {INK: "--ink", FAINT: "--faint", OURS: "--ours", PAPER: "--paper"}
STYLE = {
    "svg.fonttype": "none",
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.alpha": 0.25,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}


def inline_svg(figure: Figure, salt: str) -> str:
    """An `<svg>` element that needs nothing from outside; `salt` keeps its ids its own."""
    buffer = io.StringIO()
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # The page declares the name spaces, and sets the font and the size.
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'<svg width="[^"]*" height="[^"]*"', "<svg", text)
    text = re.sub(r"font-family: [^;\"]*;", "", text)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    return text
