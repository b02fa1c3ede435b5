"""The control that repeats actions: its draws, and the option that is made of a proposal."""

from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import MacroQ, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.discovery.methods import Repeat, method_named
from sb3_options.discovery.methods.repeats import LEAST, RandomRepeats
from sb3_options.options.option import SubgoalOption
from sb3_options.runs.inspection import contents_of, picture_of, subgoal_of
from tests.discovery.methods.test_methods import experience


def drawn(seed: int, n: int) -> list[Repeat]:
    method, lived = RandomRepeats(seed=seed), experience([0, 1])
    return [proposal for _ in range(n) for proposal in method.update(lived) if isinstance(proposal, Repeat)]


def test_actions_take_turns_and_durations_are_those_of_the_zeta_distribution() -> None:
    """P(n) ∝ 1/n², n ≥ 2: Σ 1/n² = π²/6 − 1, so that 2 steps have 0.25 / 0.645 of it."""
    repeats = drawn(0, 2000)
    numbers = np.array([repeat.number for repeat in repeats])
    assert (np.diff(numbers) == 1).all()
    counts = Counter(repeat.duration for repeat in repeats)
    assert min(counts) == LEAST == 2
    for n in (2, 3, 4):
        expected = n**-2 / (np.pi**2 / 6 - 1)
        assert counts[n] / 2000 == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / 2000))


def test_draws_are_of_the_seed() -> None:
    def told(seed: int) -> list[tuple[int, int]]:
        return [(repeat.number, repeat.duration) for repeat in drawn(seed, 20)]

    assert told(3) == told(3) != told(4)
    made = method_named("random-repeats", 3)
    first, *_ = made.update(experience([0, 1]))
    assert isinstance(first, Repeat)
    assert (first.number, first.duration) == told(3)[0]


def test_a_state_goes_on() -> None:
    one, other, lived = RandomRepeats(seed=1), RandomRepeats(seed=2), experience([0, 1])
    one.update(lived)
    other.set_state(one.get_state())
    for _ in range(5):
        (first,), (second,) = one.update(lived), other.update(lived)
        assert isinstance(first, Repeat)
        assert isinstance(second, Repeat)
        assert (first.number, first.duration) == (second.number, second.duration)


@pytest.mark.parametrize(
    ("number", "duration", "message"),
    [
        (-1, 2, "number must be a whole number of at least 0, got -1"),
        (0, 0, "duration must be a whole number of at least 1, got 0"),
        (0, 2.5, "duration must be a whole number of at least 1, got 2.5"),
    ],
)
def test_arguments(number: int, duration: int, message: str) -> None:
    with pytest.raises(ValueError, match=rf"^{message}$"):
        Repeat(number, duration, np.ones(2))


def test_options_are_made_run_for_their_time_and_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "options.safetensors"
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", max_steps=300), 3, gamma=0.97)
    callback = SubgoalDiscoveryCallback(method="random-repeats", save_path=path, min_reached=0.9, seed=5)
    MacroQ(env, gamma=0.97, seed=0).learn(4_000, callback=callback)
    options = [option for option in callback.bank.slots if isinstance(option, SubgoalOption)]
    assert len(options) == 3
    assert not callback.closed  # they have no subgoal that they might not reach
    assert [found.where for found in callback.discoveries] == [option.name for option in options]
    assert all(np.isnan(found.subgoal).all() for found in callback.discoveries)
    assert callback.discovery is not None
    assert subgoals_figure(callback.discovery, callback.bank).axes

    fresh = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), 3, gamma=0.97, options_file=path)
    actions = set()
    for slot, option in enumerate(options):
        for seed in range(5):
            fresh.reset(seed=seed)
            assert fresh.action_masks()[fresh.bank.n_primitive + slot]
            *_, info = fresh.step(fresh.bank.n_primitive + slot)
            run = info["option"]
            assert (run["duration"], run["termination"]) == (option.max_duration, "max_duration")
            actions |= {(slot, action) for action in run["actions"].tolist()}
    assert len(actions) == len({action for _, action in actions}) == 3  # each its own, always the same

    contents = contents_of(path)
    assert {subgoal_of(o, None) for o in contents.options.values() if isinstance(o, SubgoalOption)} == {"none"}
    assert len(picture_of(contents).axes) == 3
