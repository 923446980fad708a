"""Load a trained network by the name of its file."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn

from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.training.checkpoints import load_weights

CONF = Path(__file__).parents[2] / "conf"


def load(checkpoint: str = "shipped") -> Network:
    """Load a network, ready to predict: `load("shipped")(views)`.

    Args:
        checkpoint: "shipped" for the model that comes with the project, or a .ckpt file of a run,
            whose config.yaml says what it is; a .safetensors file has the shipped one's layout.

    Raises:
        InputError: no such file, or the weights of another model.
    """
    path = Path(checkpoint)
    configuration = path.parent.parent / "config.yaml"
    if path.suffix == ".ckpt" and path.is_file() and configuration.is_file():
        model = OmegaConf.load(configuration).model
    elif path.suffix == ".ckpt" and path.is_file():
        raise InputError(
            f"{checkpoint} has no {configuration}, which says what model it is: leave it in the "
            "folder of its run."
        )
    else:
        model = _default_model()
    holder = nn.Module()
    holder.net = instantiate(model)
    load_weights(checkpoint, holder)
    return holder.net.eval()


def _default_model():
    if GlobalHydra.instance().is_initialized():
        return compose("train").model
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train").model
