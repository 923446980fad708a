"""Run benchmark.py in the process of the tests."""

import json
import runpy

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf


@pytest.fixture(scope="module")
def make_options(repository):
    """The options of conf/benchmark.yaml for a suite, in two rounds on the CPU."""

    def options(suite, changes):
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            config = compose("benchmark", [f"suite={suite}", "repeats=2", "device=cpu"])
        OmegaConf.set_struct(config, False)  # a user adds overrides and variants
        return OmegaConf.merge(config, changes)

    return options


@pytest.fixture(scope="module")
def run_suite(repository, make_options, tmp_path_factory):
    """Run a suite with changed options, or with all of its options; return what it writes."""
    script = runpy.run_path(str(repository / "benchmark.py"))

    def run(suite, changes):
        folder = tmp_path_factory.mktemp("benchmark")
        options = make_options(suite, changes) if isinstance(changes, dict) else changes
        options.output = str(folder)
        with initialize_config_dir(str(repository / "conf"), version_base=None):
            script["benchmark"].__wrapped__(options)
        return json.loads((folder / f"{suite}.json").read_text(), parse_constant=pytest.fail)

    return run
