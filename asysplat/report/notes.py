"""The notes of a table: how both sides were measured, and how far to trust the order."""

from asysplat.report.filled import CLEAR_SIGNAL, FilledTable, RankAgreement, rank_agreement
from asysplat.report.paper import kind_titles, set_titles
from asysplat.report.sheet import Note

BASELINES = {"mean_color": "mean color", "nearest_view": "nearest view, copied"}


def notes(filled: FilledTable) -> list[Note]:
    """Write the notes below a table, from what is compared to the command that made it."""
    lines = [
        Note("Paper", filled.paper.protocol),
        Note("Ours", filled.scale),
        Note("Stand-ins", _stand_ins(filled)),
        Note("Not tested", _untested(filled)),
        Note("For nothing", _baselines(filled)),
        Note("Seeds", _seeds(filled)),
        Note("Order", _order(filled)),
        *_remarks(filled),
        Note("Data", _folders(filled)),
        Note("Revision", _revisions(filled)),
        Note("Machine", filled.machine),
        Note("Command", filled.command, code=True),
    ]
    return [line for line in lines if line.text]


def protocol_notes(filled: FilledTable) -> list[Note]:
    """Write the notes above a table: the protocol of our metrics, a sentence for each."""
    kinds = {column.key.rpartition("/")[-1] for column in filled.paper.columns}
    lines = []
    if len(filled.protocols) > 1:
        lines.append(Note("Metrics", "runs of several protocols are mixed, see below"))
    for protocol in filled.protocols:
        sentences = [
            f"{kind_titles()[kind]}: {text}" for kind, text in protocol.items() if kind in kinds
        ]
        lines.append(Note("Metrics", ". ".join([f"protocol {protocol['name']}", *sentences])))
    return lines


def rho_text(filled: FilledTable) -> str:
    """Write Spearman's rho of the column that the table is ranked by."""
    if filled.paper.rank_by is None:
        return "-"
    agreement = rank_agreement(filled, filled.paper.rank_by)
    if agreement.rho is None:
        return "-"
    doubt = "?" if agreement.signal is None or agreement.signal < CLEAR_SIGNAL else ""
    return f"{agreement.rho:.2f}{doubt} ({agreement.rows} rows)"


def _stand_ins(filled: FilledTable) -> str:
    if filled.paper.number is None:
        return ""
    pairs = [(key, ours) for key, ours in filled.sets.items() if ours != key]
    return "; ".join(f"{set_titles()[key]} by our test set {ours}" for key, ours in pairs)


def _untested(filled: FilledTable) -> str:
    return "; ".join(f"{set_titles()[key]}, for want of paths.{key}=..." for key in filled.untested)


def _folders(filled: FilledTable) -> str:
    if len(filled.folders) < 2:
        return "".join(filled.folders)
    folders = "; ".join(filled.folders)
    return f"runs on several are mixed, name one with data.root=... in overrides: {folders}"


def _revisions(filled: FilledTable) -> str:
    """Name the revision of the code; where there are several, the rows of each."""
    rows: dict[str, list[str]] = {}
    for row in filled.rows:
        for revision in row.revisions:
            rows.setdefault(revision, []).append(row.name)
    if len(rows) < 2:
        return "".join(rows)
    parts = [f"{revision}: {', '.join(names)}" for revision, names in rows.items()]
    return f"runs of several are mixed: {'; '.join(parts)}"


def _baselines(filled: FilledTable) -> str:
    """Write the PSNR of baselines without a network, to read every other beside."""
    sets = []
    for name, entry in filled.baselines.items():
        numbers = [f"{BASELINES.get(key, key)} {psnr:.2f} dB" for key, psnr in entry.items()]
        sets.append(f"{name}: {', '.join(numbers)}")
    return "; ".join(sets)


def _seeds(filled: FilledTable) -> str:
    seeds = sorted({seed for row in filled.rows for seed in row.seeds})
    if not seeds:
        return ""
    if len(seeds) == 1:
        return f"{seeds[0]} alone, so no spread"
    return f"{', '.join(map(str, seeds))}: mean ± sample standard deviation over them"


def _order(filled: FilledTable) -> str:
    if filled.paper.rank_by is None:
        return ""
    agreement = rank_agreement(filled, filled.paper.rank_by)
    column = next(c for c in filled.paper.columns if c.key == filled.paper.rank_by)
    ours = filled.our_title(column)
    if agreement.rho is None:
        return f"cannot be compared by {ours}: rows with both numbers: {agreement.rows}"
    return (
        f"Spearman's rho of our {ours} with the paper's {column.title} is {agreement.rho:.2f} over "
        f"{agreement.rows} rows; {_trust(agreement)}"
    )


def _trust(agreement: RankAgreement) -> str:
    if agreement.signal is None:
        return "one seed a row does not tell whether the order means anything"
    if agreement.signal < CLEAR_SIGNAL:
        return (
            f"rows differ {agreement.signal:.1f} x as much as seeds alone make them: "
            "the order means little"
        )
    return f"rows differ {agreement.signal:.1f} x as much as seeds alone make them"


def _remarks(filled: FilledTable) -> list[Note]:
    """Write remarks on single rows; rows with the same remark share a line."""
    names: dict[str, list[str]] = {}
    for row in filled.rows:
        if row.paper.quoted:
            names.setdefault("quoted", []).append(row.name)
        elif row.note:
            names.setdefault(row.note, []).append(row.name)
    shared = [Note(note[0].upper() + note[1:], "; ".join(rows)) for note, rows in names.items()]
    open_layouts = [
        Note(f"† {row.paper.name}", row.paper.unverified)
        for row in filled.rows
        if row.paper.unverified
    ]
    return shared + open_layouts
