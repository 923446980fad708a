"""What TensorBoard shows of a run."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

MEASURED = ("cost/", "time/", "memory/")


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Steps and values by tag; of a step that was repeated after a resume, the last.

    What differs from run to run is left out: costs, seconds and memory.
    """
    events = _events(folder)
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(MEASURED)]
    rows = {tag: {event.step: event.value for event in events.Scalars(tag)} for tag in tags}
    return {tag: sorted(row.items()) for tag, row in rows.items()}


def steps(folder: Path, kind: str) -> dict[str, list[int]]:
    """Steps by tag, of "scalars", "images" or "histograms"."""
    events = _events(folder)
    read = {"scalars": events.Scalars, "images": events.Images, "histograms": events.Histograms}
    tags = events.Tags()[kind]
    return {tag: sorted({event.step for event in read[kind](tag)}) for tag in tags}


def _events(folder: Path) -> EventAccumulator:
    everything = {"scalars": 0, "images": 0, "histograms": 0}
    return EventAccumulator(str(folder / "tensorboard"), size_guidance=everything).Reload()
