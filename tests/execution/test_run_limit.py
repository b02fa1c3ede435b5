"""`max_runs` counts runs of one option in one episode."""

import gymnasium as gym

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from tests.options.banks import along_row_5


def make(max_runs: int) -> OptionsWrapper:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", success_probability=1.0), max_runs=max_runs)
    east, west = 3, 2
    for action in (east, west):
        env.bank.add(along_row_5(8.0, 2, 8, action))
    return env


def run(env: OptionsWrapper, actions: list[int]) -> list[int]:
    """Which slot each of the actions ran."""
    return [env.step(action)[4]["option"]["index"] for action in actions]


def test_an_option_that_has_run_so_often_counts_as_empty_until_the_next_episode() -> None:
    env = make(2)
    for seed in (0, 1):
        env.reset(seed=seed, options={"start": (5, 5)})
        for _ in range(2):
            assert env.action_masks()[4:6].tolist() == [True, True]
            assert env.step(4)[4]["option"]["termination"] == "subgoal"
            env.step(2)  # back into the initiation set
        assert env.action_masks()[4:6].tolist() == [False, True]
        info = env.step(4)[4]["option"]
        assert (info["index"], info["duration"]) == (-1, 1)
        assert 0 <= int(info["actions"][0]) < 4


def test_what_may_start_next_keeps_to_it() -> None:
    env = make(1)
    env.set_slots(report_availability=True)
    env.reset(seed=0, options={"start": (5, 5)})
    available = env.step(4)[4]["option"]["available"]
    assert available[:, :2].tolist() == [[True, True], [True, True], [False, False]]  # on the way; at the subgoal
    observation, _, _, _, info = env.step(2)  # back into the initiation set
    assert info["option"]["available"][:, :2].tolist() == [[False, True]]
    assert env.available(observation[None])[0, 4:6].tolist() == [True, True]


def test_another_option_in_the_slot_counts_anew() -> None:
    env = make(1)
    env.reset(seed=0, options={"start": (5, 5)})
    option = env.bank[0]
    run(env, [4, 2])
    env.set_option(0, option)  # one that has grown
    assert not env.action_masks()[4]
    env.set_option(0, None)
    env.set_option(0, option)
    assert env.action_masks()[4]


def test_a_step_outside_the_initiation_set_is_no_run() -> None:
    env = make(1)
    env.reset(seed=0, options={"start": (9, 5)})
    assert run(env, [5, 5]) == [1, 1]  # at 9, then at the subgoal
