"""`SubgoalDiscoveryCallback` with a method other than diverse density: an option is made, used and drawn."""

from pathlib import Path

import numpy as np

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.density.regions import Region
from sb3_options.discovery.figures import map_figure
from sb3_options.discovery.methods import Experience
from sb3_options.learning.macro_q import MacroQ
from tests.callbacks.doorway import STEPS, model_of
from tests.support.sb3_helpers import DOORWAY, optioned_rooms


class AtTheDoorway:
    """A user's own method."""

    def update(self, experience: Experience) -> list[Region]:
        return [experience.region(np.array(DOORWAY))] if experience.success else []


def test_an_option_is_made_of_what_a_method_proposes(tmp_path: Path) -> None:
    callback = SubgoalDiscoveryCallback(method=AtTheDoorway(), max_new_options=1)
    callback.save_path = tmp_path / "options.safetensors"
    model_of(tensorboard_log=str(tmp_path)).learn(STEPS, callback=callback)
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert np.isnan(found.log_density)
    assert callback.discovery is not None
    assert map_figure(callback.discovery, callback.bank) is not None
    fresh = optioned_rooms()
    fresh.bank.load(callback.save_path)
    assert len(fresh.bank) == 1


def test_methods_are_told_of_failures_whatever_bags_there_are() -> None:
    class Counting:
        told = 0

        def update(self, experience: Experience) -> list[Region]:
            del experience
            self.told += 1
            return []

    env = optioned_rooms(1, max_steps=20)
    callback = SubgoalDiscoveryCallback({"negative_strength": 0}, method=(method := Counting()))
    MacroQ(env, gamma=0.9, seed=0).learn(200, callback=callback)
    assert method.told == callback.episodes >= 10
