"""Load a model: `asysplat.load("shipped")`, or a trained network by the name of its file."""

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from torch import nn

from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.overrides import check_overrides
from asysplat.root import CONF
from asysplat.runs.checkpoints import load_weights
from asysplat.runs.run_config import read_config

SHIPPED_MODEL = "model=plane_sweep"


def load(checkpoint: str | None = "shipped", overrides: Sequence[str] = ()) -> Network:
    """Load a model in evaluation mode: `load("shipped")(views)`.

    Args:
        checkpoint: "shipped" for the plane sweep, which needs no training; a .ckpt file in the
            folder of its run, whose config.yaml describes the network; a .safetensors file of the
            network that `overrides` describe; None: that network, untrained.
        overrides: options of train.py (`model.planes=96`); a run's network ignores them.

    Raises:
        InputError: no such file, the weights of another model, or an unknown override.

    Example:
        >>> from asysplat import load, open_photographs
        >>> photographs = open_photographs("my_scene", height=64, views=4)
        >>> gaussians = load("shipped")(photographs.inputs)
        >>> gaussians.means.shape[-1]
        3
    """
    path = Path(checkpoint or "")
    if path.suffix == ".ckpt" and path.is_file():
        config_path = path.parent.parent / "config.yaml"
        if not config_path.is_file():
            raise InputError(
                f"{checkpoint} has no {config_path}, which describes its model: leave it in the "
                "folder of its run."
            )
        net = instantiate(read_config(config_path).model)
    else:
        if checkpoint == "shipped":
            checkpoint, overrides = None, [SHIPPED_MODEL, *overrides]
        check_overrides(overrides)
        initialized = GlobalHydra.instance().is_initialized()
        with nullcontext() if initialized else initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("train", list(overrides))
        net = instantiate(config.model)
    weights = nn.ModuleDict({"net": net})  # named as in a checkpoint
    load_weights(checkpoint, weights, option="checkpoint")
    return net.eval()
