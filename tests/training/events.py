"""What TensorBoard shows of a run."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

MEASURED = ("cost/", "time/", "memory/")


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Steps and values by tag, in the order in which they were written.

    What differs from run to run is left out: costs, seconds and memory.
    """
    events = _events(folder)
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(MEASURED)]
    # Files are read in the order of their names, which have the second and then the process.
    rows = {tag: sorted(events.Scalars(tag), key=lambda event: event.wall_time) for tag in tags}
    return {tag: [(event.step, event.value) for event in row] for tag, row in rows.items()}


def steps(folder: Path, kind: str) -> dict[str, list[int]]:
    """Steps by tag, of "scalars", "images" or "histograms"."""
    events = _events(folder)
    read = {"scalars": events.Scalars, "images": events.Images, "histograms": events.Histograms}[
        kind
    ]
    return {tag: [event.step for event in read(tag)] for tag in events.Tags()[kind]}


def _events(folder: Path) -> EventAccumulator:
    everything = {"scalars": 0, "images": 0, "histograms": 0}
    return EventAccumulator(str(folder / "tensorboard"), size_guidance=everything).Reload()
