"""Define the style of every plot."""

INK, FAINT, OURS, PAPER = "#101112", "#909192", "#1f6feb", "#c2570c"
STYLE = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # $ in a name is a letter
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
