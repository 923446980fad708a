"""Write the notes of a table: how both sides were measured, and how far to trust the order."""

from collections.abc import Mapping, Sequence

from paper.compare import CLEAR_SIGNAL, rank_agreement
from paper.grid import Note
from paper.tables import PaperTable, set_titles

SHOWN = 3  # options of a remark that are not folded away


def notes(filled: PaperTable) -> list[Note]:
    """Write the notes below a table, from what is compared to the command of our numbers."""
    other_sets = [(key, ours) for key, ours in filled.sets.items() if ours != key]
    substitutes = [f"{set_titles()[key]} by our test set {ours}" for key, ours in other_sets]
    texts = {
        "Paper": filled.protocol,
        "Substitutes": "" if filled.number is None else "; ".join(substitutes),
        "Seeds": _seeds(filled),
        "Order": _order(filled),
        "Revision": _revisions(filled),
        **filled.notes,
    }
    above = ("Paper", "Ours", "Head", "Substitutes", "Not tested", "Baselines", "Seeds", "Order")
    below = ("Data", "Revision", "Machine", "Command")
    lines = [Note(label, texts.get(label, "")) for label in above]
    lines += _remarks(filled)
    lines += [Note(label, texts.get(label, ""), code=label == "Command") for label in below]
    return [line for line in lines if line.text]


def protocol_notes(filled: PaperTable) -> list[Note]:
    """Write the notes above a table: the protocols of our metrics."""
    mixed = ["runs of several protocols are mixed, see below"] * (len(filled.metrics) > 1)
    return [Note("Metrics", text) for text in (*mixed, *filled.metrics)]


def rho_text(filled: PaperTable) -> str:
    """Format Spearman's rho of the column that the table is ranked by."""
    column = filled.ranked_column
    rho, rows, signal = rank_agreement(filled, column.key) if column else (None, 0, None)
    if rho is None:
        return "-"
    return f"{rho:.2f}{'?' if signal is None or signal < CLEAR_SIGNAL else ''} ({rows} rows)"


def _seeds(filled: PaperTable) -> str:
    seeds = sorted({seed for row in filled.rows for seed in row.seeds})
    if len(seeds) == 1:
        return f"{seeds[0]} alone, so no spread"
    text = ", ".join(map(str, seeds))
    return f"{text}: mean ± sample standard deviation over them" if seeds else ""


def _order(filled: PaperTable) -> str:
    column = filled.ranked_column
    if column is None:
        return ""
    rho, rows, signal = rank_agreement(filled, column.key)
    ours = filled.our_title(column)
    if rho is None:
        return f"cannot be compared by {ours}: rows with both numbers: {rows}"
    if signal is None:
        trust = "one seed a row does not show whether the order means anything"
    else:
        trust = f"rows differ {signal:.1f} x as much as seeds alone make them"
        trust += ": the order means little" * (signal < CLEAR_SIGNAL)
    return (
        f"Spearman's rho of our {ours} with the paper's {column.title()} is {rho:.2f} over "
        f"{rows} rows; {trust}"
    )


def _remarks(filled: PaperTable) -> list[Note]:
    """Write remarks on single rows; rows with the same remark share a line."""
    rows: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for row in filled.rows:
        if row.quoted or row.note:
            rows.setdefault((row.note or "quoted", row.options), []).append(row.label)
    remarks = []
    for (note, options), names in rows.items():
        label, _, details = note.partition(": ")
        texts = ("; ".join(names), details, ", ".join(options[:SHOWN]))
        text = ": ".join(filter(None, texts))
        remarks.append(Note(label[0].upper() + label[1:], text, more=options[SHOWN:]))
    unverified = [row for row in filled.rows if row.unverified]
    return remarks + [Note(f"† {row.name}", row.unverified) for row in unverified]


def _revisions(filled: PaperTable) -> str:
    """Name the revision of the code; if there are several, the rows of each."""
    rows: dict[str, list[str]] = {}
    for row in filled.rows:
        for revision in row.revisions:
            rows.setdefault(revision, []).append(row.label)
    return "runs of several are mixed: " * (len(rows) > 1) + rows_by_text(rows)


def data_text(name: str, places: str | None) -> str:
    """Name the data, and the kind of its synthetic scenes if they are of one only."""
    return f"{name} data" + f" ({places})" * (places not in (None, "both"))


def rows_by_text(rows: Mapping[str, Sequence[str]]) -> str:
    """Write each text with the rows that it is about; a single text, which is about all, alone."""
    if len(rows) < 2:
        return "".join(rows)
    return "; ".join(f"{text}: {', '.join(names)}" for text, names in rows.items())
