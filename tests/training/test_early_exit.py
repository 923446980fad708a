"""Early-exit fractions are logged for each test set, and `speed` changes a run's hash."""

from types import SimpleNamespace
from unittest.mock import Mock

import lightning
import pytest
from omegaconf import OmegaConf

from asysplat.evaluation.protocol import Protocol
from asysplat.runs.runs import config_hash
from asysplat.training.callbacks import Metrics
from asysplat.training.module import SplattingModule
from asysplat.training.parallel import Prediction


def logged(tests):
    """Results and log of the callback after a test with these fractions for each scene."""
    log = {}
    net = SimpleNamespace(early_exit_fractions={})
    module = Mock(SplattingModule, net=net, log_dict=log.update)
    data = SimpleNamespace(tests=tests)
    trainer = Mock(lightning.Trainer, datamodule=data, world_size=1, is_global_zero=False)
    callback = Metrics(
        Mock(Protocol, describe=dict, mean_over="images"), "unused", backbone_dir="unused"
    )
    callback._add = Mock()
    callback.on_test_epoch_start()
    for index, scenes in enumerate(tests.values()):
        for number, fractions in enumerate(scenes):
            net.early_exit_fractions = fractions
            batch = {"scene": [f"scene {number}"]}
            callback.on_test_batch_end(trainer, module, Mock(Prediction), batch, number, index)
    callback.on_test_epoch_end(trainer, module)
    return callback.results, log


def test_means_over_the_scenes_of_each_set():
    results, log = logged({"rooms": [{"layers": 0.5}, {"layers": 1.0}], "fern": [{"layers": 0.25}]})
    assert results == log == {"early_exit/rooms/layers": 0.75, "early_exit/fern/layers": 0.25}
    assert logged({"rooms": [{}, {}]}) == ({}, {})  # exact


@pytest.mark.medium
def test_each_speed_has_a_hash_of_its_own(composed):
    hashes = {config_hash(composed(f"speed={name}")) for name in ("exact", "balanced", "fast")}
    assert len(hashes) == 3
    assert config_hash(composed("speed.skip_network_above=0.2")) not in hashes


def test_presets_name_the_same_thresholds(repository):
    files = [OmegaConf.load(path) for path in (repository / "conf" / "speed").glob("*.yaml")]
    assert len(files) == 3
    assert len({tuple(file) for file in files}) == 1
