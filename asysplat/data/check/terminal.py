"""A report on one screen."""

from collections.abc import Iterator
from math import atan, degrees, isfinite

from rich.console import Console
from rich.table import Table
from rich.text import Text

from asysplat.data.check.report import Report
from asysplat.data.check.verdict import Fit
from asysplat.data.images import Lens

MOST_LENSES = 3  # that are told one by one
MOST_DAMAGED = 10
AGREES = (0.8, 1.25)  # depth maps over triangulated depths, in the median


def print_report(report: Report, title: str, console: Console) -> None:
    """What was read, line by line, and the verdict last, where it is seen."""
    table = Table(title=Text(title, "bold"), title_justify="left", box=None, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in _lines(report):
        table.add_row(name, Text(text))
    console.print(table)
    style = "bold green" if report.verdict.fits else "bold red"
    sentence = report.verdict.sentence
    console.print(Text(f"{sentence[0].upper()}{sentence[1:]}.", style))


def _lines(report: Report) -> Iterator[tuple[str, str]]:
    capture, pixels, path = report.capture, report.pixels, report.path
    same = f", {report.identical} with the same file as another" if report.identical else ""
    yield "frames", f"{capture.num_frames}{same}"
    for lens, count in report.lenses[:MOST_LENSES]:
        yield "images", f"{count} of {_lens(lens)}"
    if len(report.lenses) > MOST_LENSES:
        yield "", f"and {len(report.lenses) - MOST_LENSES} other lenses"
    yield "brightness", "{:.2f} to {:.2f}, means of images in [0, 1]".format(*pixels.brightness)
    yield "path", f"{path.length:.4g} long, {path.extent:.4g} wide"
    yield (
        "a frame",
        (
            f"{path.step:.3g} in the median, {path.longest_step:.3g} at most; "
            f"{path.turn:.2g}° in the median, {path.widest_turn:.3g}° at most"
        ),
    )
    if path.repeated:
        yield "", f"{path.repeated} frames with the pose of an earlier frame"
    yield "points", _points(report)
    yield "depth maps", _depths(report)
    counted = "none" if pixels.counted is None else f"{pixels.counted:.1%} of the pixels count"
    yield "masks", counted
    for sentence in report.damaged[:MOST_DAMAGED]:
        yield "left out", sentence
    if len(report.damaged) > MOST_DAMAGED:
        yield "", f"and {len(report.damaged) - MOST_DAMAGED} more"
    yield from _fits(report)


def _lens(lens: Lens) -> str:
    across, down = (
        degrees(atan(centre / focal) + atan((size - centre) / focal))
        for centre, focal, size in (
            (lens.cx, lens.fx, lens.width),
            (lens.cy, lens.fy, lens.height),
        )
    )
    kind = " fisheye" if lens.fisheye else " distorted" if lens.is_distorted else ""
    return (
        f"{lens.width} x {lens.height}{kind}, {across:.1f}° x {down:.1f}°: fx {lens.fx:.5g}, "
        f"fy {lens.fy:.5g}, cx {lens.cx:.5g}, cy {lens.cy:.5g}"
    )


def _points(report: Report) -> str:
    points = report.points
    if points is None:
        return "none"
    return (
        f"{points.count}, {points.seen:.1%} in front of and inside two views or more; "
        f"{points.views:g} views a point"
    )


def _depths(report: Report) -> str:
    pixels, scale = report.pixels, report.depth_scale
    if pixels.depth_known is None:
        return "none"
    text = f"known at {pixels.depth_known:.1%} of the pixels"
    if pixels.depths is not None:
        text += ", quartiles {:.4g} {:.4g} {:.4g}".format(*pixels.depths)
    if scale is None:
        return text
    text += "; over triangulated depths {:.3f} {:.3f} {:.3f}".format(*scale.ratios)
    text += f" ({scale.points} points)"
    if report.verdict.fits and not AGREES[0] < scale.ratios[1] < AGREES[1]:
        text += f": divide the unit of depth by {scale.ratios[1]:.4g}"
    return text


def _fits(report: Report) -> Iterator[tuple[str, str]]:
    verdict, matches, cameras = report.verdict, report.matches, report.capture.cameras
    pairs = matches.pairs
    if not pairs:
        yield "matches", "none"
        return
    gaps = sorted(abs(first - second) for first, second in pairs)
    yield (
        "matches",
        (
            f"{len(matches)} of {len(pairs)} pairs, {gaps[0]} to {gaps[-1]} frames apart, at "
            f"{cameras.width} x {cameras.height}"
        ),
    )
    if verdict.read is not None:
        yield "epipolar error", _fit(verdict.read)
    if verdict.undone is not None and isfinite(verdict.undone.badness):
        name = "next best" if verdict.fits else "nearest"
        yield name, f"{verdict.undone.error:.2f} px, if {verdict.mistake.name}"


def _fit(fit: Fit) -> str:
    text = f"{fit.error:.2f} px in the median, {fit.under_1px:.0%} under 1 px"
    return text + (f"; {fit.behind:.0%} lie behind a camera" if fit.behind >= 0.01 else "")
