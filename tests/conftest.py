"""What every test gets: a seed, the shared data if it is there, and no GPU test without a GPU."""

import os
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

REPO = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared photographs and weights; a test that asks for it is skipped without."""
    folder = Path(os.environ.get("ASYSPLAT_SHARED", REPO.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set ASYSPLAT_SHARED")
    return folder


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPO


@pytest.fixture(scope="session")
def build(repository):
    """The network that `train.py` would build for these overrides."""

    def network(*overrides: str, device: str = "cpu") -> torch.nn.Module:
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            config = compose("train", list(overrides))
        with torch.device(device):
            return instantiate(config.model)

    return network


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
