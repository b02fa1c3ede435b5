"""An option from its start to its end, by way of the wrapper."""

import copy
import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import Option, OptionsWrapper
from sb3_options.execution.wrapper import TERMINATION_SEED
from tests.support.helpers import CountingEnv, TableEnv, equal, random_state, steady_option, table_option


def reference(
    env: TableEnv, option: Option, slot: int, gamma: float, observation: int, draws: np.random.Generator
) -> tuple[list[int], list[float], tuple[Any, ...], str]:
    """The hand-written loop: actions, rewards, what the last step returned, and why the option ended."""
    tables: Any = option
    inside = bool(tables.initiation(np.array([observation]))[0])
    actions, rewards = [], []
    for k in itertools.count(1):
        actions.append(int(tables.policy(np.array([observation]))[0]))
        last = env.step(actions[-1])
        observation, reward, terminated, truncated, _ = last
        rewards.append(reward)
        if terminated:
            return actions, rewards, last, "terminated"
        if truncated:
            return actions, rewards, last, "truncated"
        beta = float(tables.termination(np.array([observation]))[0])
        if beta == 1.0 or (0.0 < beta < 1.0 and draws.random() < beta):
            return actions, rewards, last, "subgoal"
        if not inside or not tables.initiation(np.array([observation]))[0]:
            return actions, rewards, last, "left_initiation"
        if k == option.max_duration:
            return actions, rewards, last, "max_duration"
    raise AssertionError


def test_an_option_is_a_hand_written_loop_over_1000_random_cases() -> None:
    rng = np.random.default_rng(0)
    ends: Counter[str] = Counter()
    longest, cases = 0, 0
    while cases < 1000:
        inner = TableEnv(rng)
        gamma = float(rng.choice([1.0, rng.uniform(0.01, 1.0)]))
        twin, env = copy.deepcopy(inner), OptionsWrapper(inner, max_options=3, gamma=gamma)
        env.set_slots(report_availability=True)
        for slot in (0, 2):
            termination = rng.choice([0.0, 0.0, 0.0, 1.0, rng.random()], size=8)
            initiation, policy = rng.random(8) < rng.choice([0.5, 0.9, 1.0]), rng.integers(3, size=8)
            termination = termination > 0.5 if rng.random() < 0.3 else termination
            duration = int(rng.integers(1, 30))
            env.bank.add(table_option(initiation, policy, termination, max_duration=duration), slot)
        seed = int(rng.integers(2**31))
        draws = np.random.default_rng([seed, TERMINATION_SEED])
        observation = env.reset(seed=seed)[0]
        assert observation == twin.reset(seed=seed)[0]
        terminated = truncated = False
        while not (terminated or truncated):
            slot = int(rng.choice([0, 2]))
            option: Any = env.bank[slot]
            actions, rewards, last, why = reference(twin, option, slot, gamma, observation, draws)
            before = observation
            observation, total, terminated, truncated, info = env.step(3 + slot)
            about = info.pop("option")

            k = len(actions)
            assert total == pytest.approx(sum(gamma**i * r for i, r in enumerate(rewards)), rel=1e-12, abs=1e-12)
            assert (observation, terminated, truncated, info) == (last[0], *last[2:])
            assert (about["index"], about["duration"], about["termination"]) == (slot, k, why)
            assert about["discount"] == pytest.approx(gamma**k, rel=1e-12)
            assert about["actions"].tolist() == actions
            assert about["rewards"].tolist() == rewards
            assert about["rewards"].sum() == pytest.approx(sum(rewards))
            assert about["observations"][0] == before
            arrived = np.append(about["observations"][1:], observation)
            assert equal(about["available"], env.available(arrived)[:, 3:])
            ends[why] += 1
            longest = max(longest, k)
            cases += 1
        assert random_state(inner) == random_state(twin)
    assert sum(n >= 50 for n in ends.values()) == 5  # of all that `reference` names
    assert longest > 10


EVERY_END = table_option([1, 1, 0], [0] * 3, [0, 0, 1], max_duration=2)


# With γ = 1/2, a run from 0 over k steps returns 1, 1 + 2/2, 2 + 3/4, 2.75 + 4/8 = 3.25 for k = 1, 2, 3, 4.
@pytest.mark.parametrize(
    ("option", "flags", "termination", "k", "total"),
    [
        (table_option([1] * 9, [0] * 9, [0, 0, 0, 1, 0, 0, 0, 0, 0]), {}, "subgoal", 3, 2.75),
        (table_option([1, 1, 0, 1, 1, 1, 1, 1, 1], [0] * 9, [0] * 9), {}, "left_initiation", 2, 2.0),
        (table_option([1] * 9, [0] * 9, [0] * 9, max_duration=4), {}, "max_duration", 4, 3.25),
        (table_option([1] * 9, [0] * 9, [0] * 9, max_duration=1), {}, "max_duration", 1, 1.0),
        (table_option([1] * 9, [0] * 9, [0] * 9), {"terminate_at": 3}, "terminated", 3, 2.75),
        (table_option([1] * 9, [0] * 9, [0] * 9), {"truncate_at": 2}, "truncated", 2, 2.0),
        # The end of an episode goes before all else, β before I, and I before the longest duration.
        (EVERY_END, {"terminate_at": 2}, "terminated", 2, 2.0),
        (EVERY_END, {"truncate_at": 2}, "truncated", 2, 2.0),
        (EVERY_END, {"truncate_at": 2, "terminate_at": 2}, "terminated", 2, 2.0),
        (EVERY_END, {}, "subgoal", 2, 2.0),
        (table_option([1, 1, 0], [0] * 3, [0, 0, 0], max_duration=2), {}, "left_initiation", 2, 2.0),
        # β where it starts does not count: an option runs for one step at least.
        (table_option([1] * 9, [0] * 9, [1, 0, 1, 0, 0, 0, 0, 0, 0]), {}, "subgoal", 2, 2.0),
    ],
)
def test_terminations_by_hand(option: Option, flags: dict[str, Any], termination: str, k: int, total: float) -> None:
    env = OptionsWrapper(CountingEnv(**flags), max_options=2, gamma=0.5)
    env.bank.add(option, 1)
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(3)
    ends = flags.get("terminate_at") == k, flags.get("truncate_at") == k
    assert (observation.tolist(), reward, terminated, truncated) == ([k], total, *ends)
    about = info["option"]
    assert (about["index"], about["duration"], about["discount"]) == (1, k, 0.5**k)
    assert about["termination"] == termination
    assert about["observations"].ravel().tolist() == list(range(k))
    assert about["rewards"].tolist() == list(range(1, k + 1))
    assert info.get("time") == k


@pytest.mark.parametrize(
    ("initiation", "termination", "why"),
    [
        ([0, 1, 1, 1], [0, 0, 0, 0], "left_initiation"),  # although the step leads into I
        ([0, 0, 0, 0], [0, 0, 0, 0], "left_initiation"),
        ([0, 1, 1, 1], [0, 1, 0, 0], "subgoal"),
    ],
)
def test_an_option_chosen_outside_its_initiation_set_it_runs_one_step_of_its_own_policy(
    initiation: list[int], termination: list[int], why: str
) -> None:
    inner = CountingEnv(n_actions=5)
    env = OptionsWrapper(inner)
    env.bank.add(table_option(initiation, [3, 1, 1, 1], termination, max_duration=3))
    env.reset(seed=0)
    about = env.step(5)[4]["option"]
    assert (about["index"], about["duration"], about["termination"]) == (0, 1, why)
    assert inner.actions == [3]


def test_a_policy_that_names_no_primitive() -> None:
    env = OptionsWrapper(CountingEnv())
    env.bank.add(steady_option(2, name="mine"))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^The policy of option 'mine' chose 2; primitive actions are 0 to 1\.$"):
        env.step(2)


@pytest.mark.parametrize("as_dict", [False, True])
def test_an_environment_that_writes_in_place(as_dict: bool) -> None:
    array, shared = np.zeros(1), dict[str, Any]()

    def step(env: CountingEnv, _: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        array[:] = env.time
        return {"count": array} if as_dict else array, 0.0, False, False, shared

    inner = CountingEnv(step=step)
    if as_dict:
        inner.observation_space = spaces.Dict({"count": inner.observation_space})
    env = OptionsWrapper(inner, max_options=1)
    env.bank.add(steady_option(max_duration=4))
    env.reset(seed=0)
    env.step(0)
    about = env.step(2)[4]["option"]
    seen = about["observations"]["count"] if as_dict else about["observations"]
    assert seen.ravel().tolist() == [1, 2, 3, 4]
    assert shared == {}
