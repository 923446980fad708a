"""What users set most is refused out of its range, in one sentence, and taken within."""

import pytest
from omegaconf import OmegaConf

from asysplat.errors import InputError
from asysplat.ranges import TRAINING, check_training

REFUSED = {
    "steps=0": "steps=0 should be greater than or equal to 1.",
    "steps=null": "steps=null should be a valid integer.",
    "stages.stage1.batch_size=0": "data.batch_size=0 should be greater than or equal to 1.",
    f"seed={2**32}": "seed=4294967296 should be less than 4294967296.",
    "learning_rate=nan": "learning_rate=nan should be",
    "data.window=[12]": "data.window=[12]: List should have at least 2 items",
    "geometry_ratio=1.5": "geometry_ratio=1.5 should be less than 1.",
}


@pytest.mark.parametrize("override", REFUSED)
def test_out_of_range(composed, override):
    changed = OmegaConf.merge(composed(), OmegaConf.from_dotlist([override]))
    with pytest.raises(InputError) as raised:
        check_training(changed)
    assert str(raised.value).startswith(REFUSED[override])


@pytest.mark.parametrize("scale", ["laptop", "gpu", "paper"])
def test_every_scale_is_within_and_has_every_option(composed, scale):
    config = composed(f"scale={scale}")
    check_training(config)
    absent = object()
    assert all(OmegaConf.select(config, name, default=absent) is not absent for name in TRAINING)


def test_an_option_that_is_left_out_is_not_missed(composed):
    check_training(composed("~callbacks", "~training.schedule.warmup_steps", "geometry_ratio=0.7"))
