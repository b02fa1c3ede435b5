import importlib

from sb3_options.density.regions import HalfSpace, Region


def test_models_of_0_1_name_regions_elsewhere() -> None:
    """A pickle looks a class up by the module that it was saved under."""
    then = importlib.import_module("sb3_options.option")
    assert (then.Region, then.HalfSpace) == (Region, HalfSpace)
