"""Load a trained network by the name of its file."""

from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import nn

from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.overrides import CONF, check_overrides
from asysplat.training.checkpoints import load_weights


def load(checkpoint: str | None = "shipped", overrides: Sequence[str] = ()) -> Network:
    """Load a network, ready to predict: `load("shipped")(views)`.

    Args:
        checkpoint: "shipped" for the model that comes with the project, or a .ckpt file of a run,
            whose config.yaml says what it is; a .safetensors file has the shipped one's layout;
            None: without training.
        overrides: of train.py, which change its default model, and what it leaves out
            (`speed=fast`); a run's model stays as it is.

    Raises:
        InputError: no such file, the weights of another model, or an unknown override.
    """
    if checkpoint is None:
        return _default_network(overrides).eval()
    path = Path(checkpoint)
    configuration = path.parent.parent / "config.yaml"
    if path.suffix == ".ckpt" and path.is_file() and configuration.is_file():
        net = instantiate(OmegaConf.load(configuration).model)
    elif path.suffix == ".ckpt" and path.is_file():
        raise InputError(
            f"{checkpoint} has no {configuration}, which says what model it is: leave it in the "
            "folder of its run."
        )
    else:
        net = _default_network(overrides)
    holder = nn.Module()
    holder.net = net
    load_weights(checkpoint, holder)
    return net.eval()


def _default_network(overrides: Sequence[str]) -> Network:
    config = _default_config(overrides)
    net = instantiate(config.model)
    net.early_exit = instantiate(config.speed)
    net.check_early_exit(net.early_exit)
    return net


def _default_config(overrides: Sequence[str]) -> DictConfig:
    check_overrides(overrides)
    if GlobalHydra.instance().is_initialized():
        return compose("train", list(overrides))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", list(overrides))
