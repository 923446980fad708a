"""Warnings as one line, without Lightning's."""

import logging
import warnings

from asysplat.errors import plain_warnings


def quiet_lightning() -> None:
    """Hide Lightning's tips and deprecations; print other warnings without their line of code."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    plain_warnings()
