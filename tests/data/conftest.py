import shutil

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms


@pytest.fixture(scope="module")
def one_thread():
    """Small images gain nothing from threads, and threads slow down tests that run in parallel."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """A folder with the scenes s0 to s7, of 24 images each; no test changes it."""
    root = tmp_path_factory.mktemp("scenes")
    for seed in range(8):
        scene = ProceduralScene(seed, 16, 16, num_images=24)
        write_transforms(scene.views(range(24)), root / f"s{seed}")
    return root


@pytest.fixture
def folder(written, tmp_path):
    """Make a folder with copies of some of the scenes."""

    def copy(name, *seeds):
        for seed in seeds:
            shutil.copytree(written / f"s{seed}", tmp_path / name / f"s{seed}")
        return str(tmp_path / name)

    return copy
