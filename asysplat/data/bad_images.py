"""Frames that cannot be used: all are found and reported together, before anything starts."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from asysplat.errors import InputError

Policy = Literal["fail", "skip"]
FEWEST = 2  # frames of a scene


class BadFrames:
    """What is wrong with single frames, collected while a scene is read.

    Args:
        policy: "fail", or "skip" to go on without the frames that cannot be used.

    Raises:
        InputError: another policy.
    """

    def __init__(self, policy: Policy = "fail"):
        if policy not in ("fail", "skip"):
            raise InputError(f"on_bad_image is {policy!r}: expected fail or skip.")
        self.policy = policy
        self.sentences: list[str] = []

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Note an InputError that is raised inside, and go on after the block."""
        try:
            yield
        except InputError as error:
            self.sentences.append(str(error))

    def settle(self, scene: str, left: int) -> None:
        """Report what was noted, after all frames were read.

        Args:
            scene: its name, for the message.
            left: how many of its frames can be used.

        Raises:
            InputError: there were bad frames and they are not to be skipped, or too few are left.
        """
        listed = "".join(f"\n  {sentence}" for sentence in self.sentences)
        total = left + len(self.sentences)
        if self.sentences and self.policy == "fail":
            raise InputError(
                f"{scene}: {len(self.sentences)} of {total} frames cannot be used; fix them, or "
                f"leave them out with on_bad_image=skip:{listed}"
            )
        if left < FEWEST:
            raise InputError(
                f"{scene} has {left} usable frame(s) of {total}: a scene needs at least {FEWEST}."
                f"{listed}"
            )
        if self.sentences:
            warnings.warn(
                f"{scene}: left out {len(self.sentences)} of {total} frames:{listed}", stacklevel=2
            )
