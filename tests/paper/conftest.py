import pytest


@pytest.fixture(scope="session")
def compose(composed):
    """What `fill_table` composes with; one function, by which costs are cached."""
    return lambda overrides: composed(*overrides, return_hydra_config=True)
