"""Read published results of other methods on public scenes, which are in public.yaml."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from omegaconf import OmegaConf

from paper.tables import Number


@dataclass(frozen=True)
class PublishedRow:
    """What one method reached on a scene, or on several in the mean."""

    method: str
    psnr: Number
    source: str  # name in `published_sources`
    ssim: Number | None = None
    lpips: Number | None = None
    seconds: Number | None = None  # duration of the training
    hardware: str | None = None
    scenes: int | None = None  # how many the numbers are the mean of; None for one scene


def published_rows(protocol: str, scene: str) -> list[PublishedRow]:
    """Return the rows of a scene, or of the scene "mean", best PSNR first; empty where none is."""
    rows = (PublishedRow(**row) for row in _read().get(protocol, {}).get(scene, []))
    return sorted(rows, key=lambda row: -row.psnr)


def published_sources() -> dict[str, str]:
    """Return a line for each source: its page, when it was read and how it measured."""
    return {
        name: f"{source['page']}, read {source['read']}: {source['protocol']}"
        for name, source in _read()["sources"].items()
    }


@cache
def _read() -> dict:
    return OmegaConf.to_container(OmegaConf.load(Path(__file__).with_suffix(".yaml")))
