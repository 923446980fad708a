"""Images that cannot be used: all are collected and reported together, before anything starts."""

import warnings
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import Literal, TypeVar, TypeVarTuple

from asysplat.errors import InputError, brief

Policy = Literal["fail", "skip"]
MIN_IMAGES = 2  # in a scene
MAX_LISTED = 50  # errors in a message
Item = TypeVarTuple("Item")
Result = TypeVar("Result")


class BadImages:
    """Errors of single images of a scene; with the policy "skip" the others are used."""

    def __init__(self, policy: Policy = "fail"):
        if policy not in ("fail", "skip"):
            raise InputError(f"on_error is {policy!r}: expected fail or skip.")
        self.policy = policy
        self.errors: list[str] = []

    @contextmanager
    def collect(self, name: str = "an image") -> Generator[None]:
        """Collect an error of a file that is raised inside, and go on after the block."""
        try:
            yield
        except InputError as error:
            self.errors.append(str(error))
        except (LookupError, TypeError, ValueError) as error:  # a file that lacks something
            self.errors.append(f"{name} cannot be read ({brief(error)}).")

    def read_each(
        self, read: Callable[[*Item], Result], items: Iterable[tuple[*Item]]
    ) -> list[Result]:
        """Return `read(*item)` of every item that can be read, and collect the other errors."""
        results = []
        for index, item in enumerate(items):
            with self.collect(f"image {index}"):
                results.append(read(*item))
        return results

    def report(self, scene: str, usable: int) -> None:
        """Report the collected errors, after all images of a scene were read."""
        bad, total = len(self.errors), usable + len(self.errors)
        different = list(dict.fromkeys(self.errors))
        listed = "".join(f"\n  {error}" for error in different[:MAX_LISTED])
        if len(different) > MAX_LISTED:
            listed += f"\n  and {len(different) - MAX_LISTED} more"
        if bad and self.policy == "fail":
            raise InputError(
                f"{scene}: {bad} of {total} images cannot be used; fix them, or leave them out "
                f"with on_error=skip:{listed}"
            )
        if usable < MIN_IMAGES:
            raise InputError(
                f"{scene} has {usable} usable image(s) of {total}: a scene needs at least "
                f"{MIN_IMAGES}.{listed}"
            )
        if bad:
            warnings.warn(f"{scene}: left out {bad} of {total} images:{listed}", stacklevel=2)
