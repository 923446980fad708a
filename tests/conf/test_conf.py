"""Every file under conf/ composes, and says first how to use it."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

CONF = Path(__file__).parents[2] / "conf"
GROUPS = [
    (str(path.parent.relative_to(CONF)), path.stem)
    for path in sorted(CONF.rglob("*.yaml"))
    if path.parent != CONF
]
# Shared parts of the files that use them.
PARTS = {("model", "asysplat"), ("model", "blocks"), ("model", "one_branch"), ("data", "views")}


@pytest.mark.parametrize("group", sorted(set(GROUPS) - PARTS), ids="/".join)
def test_composes_and_builds_its_model(group):
    with initialize_config_dir(str(CONF), version_base=None):
        config = compose("train", [f"{group[0]}={group[1]}"])
    with torch.device("meta"):
        net = instantiate(config.model)
    assert sum(p.numel() for p in net.parameters()) > 1e6


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: path.stem)
def test_first_comment_is_the_command(path):
    comments = [line for line in path.read_text().splitlines()[:2] if line.startswith("# ")]
    assert any("python train.py" in comment for comment in comments)
