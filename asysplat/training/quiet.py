"""What a script's user sees of Lightning and of warnings."""

import logging
import warnings


def quiet_lightning() -> None:
    """Hide Lightning's tips and deprecations; show other warnings without their line of code."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
