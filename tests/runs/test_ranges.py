"""What users set most is refused out of its range, in one sentence, and taken within."""

import pytest
from omegaconf import OmegaConf

from asysplat.errors import InputError
from asysplat.runs.ranges import RANGES, check_ranges

REFUSED = {
    "steps=-5": "steps=-5: give a whole number of at least 1.",
    "steps=0": "steps=0: give a whole number of at least 1.",
    "steps=1e3": "steps=1000.0: give a whole number",
    "steps=abc": "steps=abc: give a whole number of at least 1.",
    "steps=null": "steps=null: give a whole number",
    "validate_every=true": "validate_every=True: give a whole number",
    "stages.stage1.batch_size=0": "data.batch_size=0: give a whole number of at least 1.",
    "seed=-1": "seed=-1: give a whole number from 0 to 4294967295.",
    "width=0": "width=0: give a number above 0.",
    "width=wide": "width=wide: give a number above 0.",
    "data.num_workers=-1": "data.num_workers=-1: give a whole number of at least 0.",
    "data.height=abc": "data.height=abc: give a whole number of at least 1.",
    "learning_rate=nan": "learning_rate=nan: give a number above 0.",
    f"learning_rate={10**400}": "learning_rate=10",  # more than a float holds
    "training.optimizer.weight_decay=-1": "training.optimizer.weight_decay=-1: give a number",
    "training.schedule.warmup_steps=2.5": "training.schedule.warmup_steps=2.5: give a whole number",
    "training.loss.depth=-1": "training.loss.depth=-1: give a number of at least 0.",
    "callbacks.monitor.every=0": "callbacks.monitor.every=0: give a whole number of at least 1.",
    "training.loss.opacity=-1": "training.loss.opacity=-1: give a number of at least 0.",
    "data.val_scenes=0": "data.val_scenes=0: give a whole number of at least 1.",
    "data.window=12": "data.window=12: give two whole numbers, such as [64,96], or null",
    "data.window=[12]": "data.window=[12]: give two whole numbers, such as [64,96], or null",
    "callbacks.checkpoints.minutes=-1": "callbacks.checkpoints.minutes=-1: give a number",
    "callbacks.non_finite_steps.budget=0": "callbacks.non_finite_steps.budget=0: "
    "give a whole number of at least 1.",
    "data.test_size=64": "data.test_size=64: give height and width in pixels, such as [64,96]",
    "data.test_size=[0,64]": "data.test_size=[0, 64]: give height and width in pixels",
    "geometry_ratio=1.5": "geometry_ratio=1.5: give a fraction between 0 and 1",
    "geometry_ratio=half": "geometry_ratio=half: give a fraction between 0 and 1",
}


@pytest.mark.parametrize("override", REFUSED)
def test_out_of_range(composed, override):
    changed = OmegaConf.merge(composed(), OmegaConf.from_dotlist([override]))
    with pytest.raises(InputError) as raised:
        check_ranges(changed)
    assert str(raised.value).startswith(REFUSED[override])


@pytest.mark.parametrize("scale", ["laptop", "gpu", "paper"])
def test_every_scale_is_within_and_has_every_option(composed, scale):
    config = composed(f"scale={scale}")
    check_ranges(config)
    for _, _, keys in RANGES:
        for key in keys:
            node = config
            for part in key.split("."):
                assert part in node, key
                node = node[part]


def test_an_option_that_is_left_out_is_not_missed(composed):
    check_ranges(composed("~callbacks", "~training.schedule.warmup_steps", "geometry_ratio=0.7"))
