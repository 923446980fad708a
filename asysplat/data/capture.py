"""What every source of posed photographs gives: a capture."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from asysplat.scene import Cameras, Views


@runtime_checkable
class Capture(Protocol):
    """An ordered walk through one static place: cameras at hand, images read when asked for.

    File readers and `ProceduralScene` both follow it, so view selection and training need not know
    where the images come from.
    """

    @property
    def name(self) -> str:
        """A name that is unique within the data set."""
        ...

    @property
    def num_frames(self) -> int:
        """How many frames there are, in the order they were taken."""
        ...

    @property
    def cameras(self) -> Cameras:
        """The cameras of all frames, [num_frames, ...]."""
        ...

    def views(self, frames: Sequence[int]) -> Views:
        """The named frames in the given order: images in [0, 1], and depths where known."""
        ...
