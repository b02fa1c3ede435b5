import copy
import itertools
import pickle
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from scipy.stats import chisquare
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import Option, OptionsWrapper
from sb3_options.density.regions import Region
from sb3_options.execution.wrapper import EMPTY_SLOT_SEED
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import CountingEnv, DictEnv, TableEnv, ball, place_of, steady_option, table_option

# Versions of gymnasium differ in the versions of Taxi they still make.
TAXI = next(env_id for env_id in ("Taxi-v3", "Taxi-v4") if env_id in gym.registry)
GRIDWORLDS = [f"sb3_options/{name}-v0" for name in ("TwoRooms", "FourRooms", "KeyDoor")]
ENVS: list[tuple[str, dict[str, Any]]] = [
    *((env_id, {"observation": kind}) for env_id, kind in itertools.product(GRIDWORLDS, ("onehot", "xy", "image"))),
    (TAXI, {}),
    ("CartPole-v1", {}),
]
env_ids = pytest.mark.parametrize(
    ("env_id", "kwargs"), ENVS, ids=[f"{i.removeprefix('sb3_options/')}-{k.get('observation', '')}" for i, k in ENVS]
)


def equal(left: Any, right: Any) -> bool:
    """Equality bit for bit, types included."""
    if type(left) is not type(right):
        return False
    if isinstance(left, dict):
        return list(left) == list(right) and all(equal(left[key], right[key]) for key in left)
    if isinstance(left, np.ndarray):
        return (left.dtype.str, left.shape, left.tobytes()) == (right.dtype.str, right.shape, right.tobytes())
    same: bool = left == right
    return same


def random_state(env: gym.Env[Any, Any]) -> Any:
    return env.unwrapped.np_random.bit_generator.state


class TestWithoutOptions:
    @env_ids
    def test_is_the_environment_itself_bit_for_bit(self, env_id: str, kwargs: dict[str, Any]) -> None:
        bare, wrapped = gym.make(env_id, **kwargs), OptionsWrapper(gym.make(env_id, **kwargs))
        assert wrapped.observation_space == bare.observation_space
        n_actions = int(bare.action_space.n)  # type: ignore[attr-defined]  # Discrete
        actions = np.random.default_rng(1).integers(n_actions, size=10_000)
        assert all(equal(a, b) for a, b in zip(bare.reset(seed=7), wrapped.reset(seed=7), strict=True))
        episodes = 0
        for action in actions:
            *expected, info = bare.step(action)
            *got, wrapped_info = wrapped.step(action)
            option = wrapped_info.pop("option")
            assert option == {"index": -1, "duration": 1, "discount": 0.99, "termination": "primitive"}
            assert all(equal(a, b) for a, b in zip(expected, got, strict=True))
            assert equal(info, wrapped_info)
            if expected[2] or expected[3]:
                episodes += 1
                seed = episodes if episodes % 3 == 0 else None
                assert all(equal(a, b) for a, b in zip(bare.reset(seed=seed), wrapped.reset(seed=seed), strict=True))
        assert episodes > 0
        assert random_state(bare) == random_state(wrapped)

    def test_reset_options_are_passed_on(self) -> None:
        env = OptionsWrapper(gym.make(GRIDWORLDS[0], observation="xy"))
        assert env.reset(options={"start": (4, 6)})[0].tolist() == [4, 6]

    def test_no_slots_at_all(self) -> None:
        env = OptionsWrapper(CountingEnv(), max_options=0)
        assert env.action_space == spaces.Discrete(2)
        env.reset(seed=0)
        assert env.action_masks().tolist() == [True, True]
        with pytest.raises(ValueError, match=r"^action must be between 0 and 1, got 2\.$"):
            env.step(2)


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


class TestOption:
    def test_is_a_hand_written_loop_over_1000_random_cases(self) -> None:
        rng = np.random.default_rng(0)
        ends: Counter[str] = Counter()
        longest, cases = 0, 0
        while cases < 1000:
            inner = TableEnv(rng)
            gamma = float(rng.choice([1.0, rng.uniform(0.01, 1.0)]))
            twin, env = copy.deepcopy(inner), OptionsWrapper(inner, max_options=3, gamma=gamma)
            env.report_availability(True)
            for slot in (0, 2):
                termination = rng.choice([0.0, 0.0, 0.0, 1.0, rng.random()], size=8)
                env.bank.add(
                    table_option(
                        rng.random(8) < rng.choice([0.5, 0.9, 1.0]),
                        rng.integers(3, size=8),
                        termination > 0.5 if rng.random() < 0.3 else termination,
                        max_duration=int(rng.integers(1, 30)),
                    ),
                    slot,
                )
            seed = int(rng.integers(2**31))
            draws = np.random.default_rng([seed, EMPTY_SLOT_SEED])
            observation = env.reset(seed=seed)[0]
            assert observation == twin.reset(seed=seed)[0]
            terminated = truncated = False
            while not (terminated or truncated):
                slot = int(rng.choice([0, 2]))
                option = env.bank[slot]
                assert option is not None
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
        assert {why for why, n in ends.items() if n >= 50} == {
            "subgoal",
            "left_initiation",
            "max_duration",
            "terminated",
            "truncated",
        }
        assert longest > 10

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
            (table_option([1, 1, 0], [0] * 3, [0, 0, 1], max_duration=2), {"terminate_at": 2}, "terminated", 2, 2.0),
            (table_option([1, 1, 0], [0] * 3, [0, 0, 1], max_duration=2), {"truncate_at": 2}, "truncated", 2, 2.0),
            (
                table_option([1, 1, 0], [0] * 3, [0, 0, 1], max_duration=2),
                {"truncate_at": 2, "terminate_at": 2},
                "terminated",
                2,
                2.0,
            ),
            (table_option([1, 1, 0], [0] * 3, [0, 0, 1], max_duration=2), {}, "subgoal", 2, 2.0),
            (table_option([1, 1, 0], [0] * 3, [0, 0, 0], max_duration=2), {}, "left_initiation", 2, 2.0),
            # β where it starts does not count: an option runs for one step at least.
            (table_option([1] * 9, [0] * 9, [1, 0, 1, 0, 0, 0, 0, 0, 0]), {}, "subgoal", 2, 2.0),
        ],
    )
    def test_terminations_by_hand(
        self, option: Option, flags: dict[str, Any], termination: str, k: int, total: float
    ) -> None:
        env = OptionsWrapper(CountingEnv(**flags), max_options=2, gamma=0.5)
        env.bank.add(option, 1)
        env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(3)
        assert observation.tolist() == [k]
        assert reward == total
        assert terminated == (flags.get("terminate_at") == k)
        assert truncated == (flags.get("truncate_at") == k)
        about = info["option"]
        assert (about["index"], about["duration"], about["discount"]) == (1, k, 0.5**k)
        assert about["termination"] == termination
        assert about["observations"].ravel().tolist() == list(range(k))
        assert about["rewards"].tolist() == list(range(1, k + 1))
        assert info.get("time") == k

    def test_a_primitive_by_hand(self) -> None:
        env = OptionsWrapper(CountingEnv(terminate_at=2), max_options=1, gamma=0.5)
        env.reset(seed=0)
        primitive = {"index": -1, "duration": 1, "discount": 0.5, "termination": "primitive"}
        assert env.step(1)[1:] == (1.0, False, False, {"time": 1, "option": primitive})
        assert env.step(1)[1:] == (2.0, True, False, {"time": 2, "option": primitive})

    def test_two_runs_one_after_the_other(self) -> None:
        env = OptionsWrapper(CountingEnv(), gamma=0.5)
        env.bank.add(steady_option(max_duration=2))
        env.reset(seed=0)
        assert [env.step(2)[1] for _ in range(3)] == [1 + 2 / 2, 3 + 4 / 2, 5 + 6 / 2]
        env.reset()
        assert env.step(2)[1] == 2.0

    @pytest.mark.parametrize(
        ("initiation", "termination", "why"),
        [
            ([0, 1, 1, 1], [0, 0, 0, 0], "left_initiation"),  # although the step leads into I
            ([0, 0, 0, 0], [0, 0, 0, 0], "left_initiation"),
            ([0, 1, 1, 1], [0, 1, 0, 0], "subgoal"),
        ],
    )
    def test_chosen_outside_its_initiation_set_it_runs_one_step_of_its_own_policy(
        self, initiation: list[int], termination: list[int], why: str
    ) -> None:
        inner = CountingEnv(n_actions=5)
        env = OptionsWrapper(inner)
        env.bank.add(table_option(initiation, [3, 1, 1, 1], termination, max_duration=3))
        env.reset(seed=0)
        about = env.step(5)[4]["option"]
        assert (about["index"], about["duration"], about["termination"]) == (0, 1, why)
        assert inner.actions == [3]

    def test_stochastic_termination(self) -> None:
        """Durations of an option with β = 1/4 everywhere are geometric."""
        env = OptionsWrapper(CountingEnv(), max_options=1)
        env.bank.add(table_option([1] * 1000, [0] * 1000, [0.25] * 1000, max_duration=1000))
        durations = []
        for seed in range(2000):
            env.reset(seed=seed)
            durations.append(env.step(2)[4]["option"]["duration"])
        observed = [sum(d == k for d in durations) for k in range(1, 8)]
        expected = [2000 * 0.75 ** (k - 1) * 0.25 for k in range(1, 8)]
        assert chisquare([*observed, 2000 - sum(observed)], [*expected, 2000 - sum(expected)]).pvalue > 0.01

        env.reset(seed=3)
        again = env.step(2)[4]["option"]["duration"]
        assert again == durations[3]

    def test_policy_that_names_no_primitive(self) -> None:
        env = OptionsWrapper(CountingEnv())
        env.bank.add(steady_option(2, name="mine"))
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"^The policy of option 'mine' chose 2; primitive actions are 0 to 1\.$"):
            env.step(2)

    def test_dict_observations(self) -> None:
        env = OptionsWrapper(DictEnv(), gamma=0.5, feature_map=place_of)
        env.report_availability(True)
        policy = TabularPolicy(np.full((1, 4), 4.0), np.array([[0.0, 1.0]]))
        env.bank.add(SubgoalOption(ball(6.0), Region(np.arange(6.0)[:, None], np.ones(1), 0.0), policy))
        observation, _ = env.reset(seed=0)
        start = int(observation["place"][0])
        observation, reward, *_, info = env.step(2)
        about = info["option"]
        assert (observation["place"].tolist(), reward) == ([6.0], 0.0)
        assert (about["duration"], about["termination"]) == (6 - start, "subgoal")
        assert about["observations"]["place"].ravel().tolist() == list(range(start, 6))
        assert about["observations"]["colour"][:, 0].tolist() == list(range(start, 6))
        assert about["available"][:, 0].tolist() == [True] * (5 - start) + [False]

    @pytest.mark.parametrize("as_dict", [False, True])
    def test_an_environment_that_writes_in_place(self, as_dict: bool) -> None:
        array, shared = np.zeros(1), dict[str, Any]()

        def step(env: CountingEnv, _: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            array[:] = env.time
            return {"count": array} if as_dict else array, 0.0, False, False, shared

        inner = CountingEnv(step=step)
        if as_dict:
            inner.observation_space = spaces.Dict({"count": inner.observation_space})
        env = OptionsWrapper(inner, max_options=1)
        env.bank.add(
            Option(
                lambda obs: np.ones(len(obs["count"] if as_dict else obs)),
                lambda obs: np.zeros(1),
                lambda obs: np.zeros(1),
                max_duration=4,
            )
        )
        env.reset(seed=0)
        env.step(0)
        about = env.step(2)[4]["option"]
        seen = about["observations"]["count"] if as_dict else about["observations"]
        assert seen.ravel().tolist() == [1, 2, 3, 4]
        assert shared == {}


class TestEmptySlot:
    def test_runs_one_uniformly_random_primitive(self) -> None:
        inner = CountingEnv(n_actions=5)
        env = OptionsWrapper(inner, max_options=3, gamma=0.5)
        env.reset(seed=0)
        n = 4000
        for i in range(n):
            observation, reward, _, _, info = env.step(5 + i % 3)
            about = info["option"]
            assert (observation.tolist(), reward) == ([i + 1], i + 1)
            assert (about["index"], about["duration"], about["discount"]) == (-1, 1, 0.5)
            assert about["termination"] == "primitive"
            assert about["actions"].tolist() == inner.actions[-1:]
        assert chisquare(np.bincount(inner.actions, minlength=5)).pvalue > 0.01
        pairs = np.array(inner.actions[:-1]) * 5 + np.array(inner.actions[1:])
        assert chisquare(np.bincount(pairs, minlength=25)).pvalue > 0.01

    def test_draws_repeat_with_the_seed(self) -> None:
        def actions(seed: int) -> list[int]:
            inner = CountingEnv(n_actions=5)
            env = OptionsWrapper(inner)
            env.reset(seed=seed)
            for _ in range(50):
                env.step(7)
            first = inner.actions
            env.reset()  # goes on with the same stream
            for _ in range(50):
                env.step(7)
            assert inner.actions != first
            return first + inner.actions

        assert actions(1) == actions(1)
        assert actions(1) != actions(2)

    def test_draws_leave_the_environments_own_random_numbers_alone(self) -> None:
        bare, env = gym.make("sb3_options/TwoRooms-v0"), OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
        bare.reset(seed=5)
        env.reset(seed=5)
        global_state: Any = np.random.get_state()  # noqa: NPY002  # it must not be used
        for _ in range(300):
            observation, *_, info = env.step(5)
            assert equal(observation, bare.step(np.int64(info["option"]["actions"][0]))[0])
        assert random_state(bare) == random_state(env)
        assert np.array_equal(global_state[1], np.random.get_state()[1])  # type: ignore[index]  # noqa: NPY002
        assert env.bank.slots == (None,) * 4

    def test_draws_are_not_those_of_the_environment(self) -> None:
        env = OptionsWrapper(CountingEnv(n_actions=1000))
        env.reset(seed=5)
        own = env.unwrapped.np_random.integers(1000, size=20).tolist()
        assert [int(env.step(1000)[4]["option"]["actions"][0]) for _ in range(20)] != own


class TestAvailable:
    def env(self) -> OptionsWrapper:
        env = OptionsWrapper(CountingEnv(), max_options=3)
        env.bank.add(table_option([1, 0, 1, 0, 1], [0] * 5, [0] * 5), 0)
        env.bank.add(table_option([0, 0, 1, 1, 1], [0] * 5, [0] * 5), 2)
        return env

    def test_batch(self) -> None:
        expected = [
            [True, True, True, False, False],
            [True, True, False, False, False],
            [True, True, True, False, True],
            [True, True, False, False, True],
        ]
        available = self.env().available(np.arange(4.0)[:, None])
        assert available.dtype == bool
        assert available.tolist() == expected

    def test_action_masks_follow_the_episode(self) -> None:
        env = self.env()
        env.reset(seed=0)
        masks = [env.action_masks()]
        for _ in range(3):
            env.step(0)
            masks.append(env.action_masks())
        np.testing.assert_array_equal(masks, env.available(np.arange(4.0)[:, None]))
        env.reset()
        assert equal(env.action_masks(), masks[0])
        env.bank.remove(0)
        assert env.action_masks().tolist() == [True, True, False, False, False]

    def test_info_has_it_for_who_asks_once_there_are_options(self) -> None:
        env = self.env()
        env.reset(seed=0)
        assert "available" not in env.step(0)[4]["option"]
        env.report_availability(True)
        env.reset(seed=0)
        assert env.step(0)[4]["option"]["available"].tolist() == [[False, False, False]]
        empty_slot = env.step(3)[4]["option"]
        assert (empty_slot["index"], empty_slot["available"].tolist()) == (-1, [[True, False, True]])
        for slot in (0, 2):
            env.set_option(slot, None)
        assert "available" not in env.step(0)[4]["option"]
        env.set_option(1, steady_option(max_duration=2))
        assert env.step(3)[4]["option"]["available"].tolist() == [[False, True, False]] * 2

    def test_set_option_fills_replaces_and_empties(self) -> None:
        env = self.env()
        option = steady_option()
        env.set_option(2, option)
        env.set_option(1, None)
        env.set_option(0, None)
        assert env.bank.slots == (None, None, option)
        with pytest.raises(ValueError, match=r"^slot must be between 0 and 2, got 3\.$"):
            env.set_option(3, option)


class TestProtocol:
    @env_ids
    @pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
    @pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
    @pytest.mark.filterwarnings("ignore:.*A Box observation space m(in|ax)imum value is -?infinity")
    def test_gymnasium_check_env(self, env_id: str, kwargs: dict[str, Any]) -> None:
        check_env(gym.make(env_id, **kwargs), skip_render_check=True)
        check_env(OptionsWrapper(gym.make(env_id, **kwargs)), skip_render_check=True)

    @env_ids
    def test_sb3_check_env(self, env_id: str, kwargs: dict[str, Any]) -> None:
        sb3_check_env(gym.make(env_id, **kwargs))
        sb3_check_env(OptionsWrapper(gym.make(env_id, **kwargs)))

    @pytest.mark.parametrize("feature_map", [None, place_of])
    @pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
    @pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
    def test_check_env_with_dict_observations(self, feature_map: Any) -> None:
        check_env(DictEnv())
        sb3_check_env(DictEnv())
        env = OptionsWrapper(DictEnv(), feature_map=feature_map)
        check_env(env)
        sb3_check_env(env)

    @pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
    def test_check_env_while_there_are_options(self) -> None:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
        env.bank.add(steady_option(3, max_duration=5))
        check_env(env, skip_render_check=True)
        sb3_check_env(env)

    @pytest.mark.parametrize(("env_id", "kwargs"), ENVS[:1] + ENVS[-2:])
    def test_spec_makes_the_wrapper_again(self, env_id: str, kwargs: dict[str, Any]) -> None:
        def flat_sum(observations: Any) -> Any:
            return np.asarray(observations, dtype=np.float64).reshape(len(observations), -1).sum(axis=1, keepdims=True)

        env = OptionsWrapper(gym.make(env_id, **kwargs), max_options=3, gamma=0.5, feature_map=flat_sum)
        assert env.spec is not None
        again = gym.make(env.spec)
        assert isinstance(again, OptionsWrapper)
        assert (again.action_space, again.gamma, again.bank.max_options) == (env.action_space, 0.5, 3)
        assert again.feature_kind() == "given"
        assert equal(again.reset(seed=1)[0], env.reset(seed=1)[0])

    def test_make_by_name_with_wrapper_and_keyword_arguments_as_in_a_configuration_file(self) -> None:
        env = OptionsWrapper(env=CountingEnv(), max_options=3, gamma=0.9)
        assert env.action_space == spaces.Discrete(5)

    def test_an_environment_that_refuses_to_be_copied_may_give_the_feature_map(self) -> None:
        class Uncopyable(CountingEnv):
            def coordinates(self, observations: Any) -> Any:
                return observations

            def __deepcopy__(self, memo: Any) -> "Uncopyable":
                raise TypeError("a simulation cannot be copied")

        inner = Uncopyable()
        assert OptionsWrapper(inner, feature_map=inner.coordinates).features is not None

    @pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
    def test_a_copy_goes_on_alike(self, how: Any) -> None:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
        cells = Region(np.array([[x, 5.0] for x in range(10)]), np.ones(2), 0.0)
        option = SubgoalOption(ball(10.0, 5.0), cells, TabularPolicy(np.zeros((1, 210)), np.eye(4)[3:]))
        env.bank.add(option)
        env.reset(seed=0, options={"start": (2, 5)})
        twin = how(env)
        for action in (3, 4, 5, 6, 4, 5):
            left, right = env.step(action), twin.step(action)
            assert equal(left[0], right[0])
            assert equal(left[4], right[4])
        assert env.action_space == twin.action_space

    def test_an_environment_that_masks_its_own_actions_goes_on_doing_so(self) -> None:
        class Masked(CountingEnv):
            def action_masks(self) -> list[bool]:
                return [self.time % 2 == 0, True]

        env = OptionsWrapper(Masked(), 2)
        env.bank.add(steady_option())
        env.reset()
        assert env.action_masks().tolist() == [True, True, True, False]
        env.step(1)
        assert env.action_masks().tolist() == [False, True, True, False]
        env.step(1)
        assert env.action_masks().tolist() == [True, True, True, False]

    def test_action_masks_and_options_need_a_reset(self) -> None:
        env = OptionsWrapper(CountingEnv())
        env.bank.add(steady_option())
        with pytest.raises(gym.error.ResetNeeded, match=r"^action_masks\(\) needs a current observation: call reset"):
            env.action_masks()
        with pytest.raises(gym.error.ResetNeeded, match=r"^step\(\) needs a current observation: call reset"):
            env.step(2)

    @pytest.mark.parametrize("action", [-1, 4, 100])
    def test_no_such_action(self, action: int) -> None:
        env = OptionsWrapper(CountingEnv(), max_options=2)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=rf"^action must be between 0 and 3, got {action}\.$"):
            env.step(action)
        assert env.unwrapped.time == 0  # type: ignore[attr-defined]  # of CountingEnv


class TestOptionsFile:
    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
        cells = Region(np.array([[x, 5.0] for x in range(10)]), np.ones(2), 0.0)
        env.bank.add(SubgoalOption(ball(10.0, 5.0), cells, TabularPolicy(np.zeros((1, 210)), np.eye(4)[3:])), 1)
        env.bank.save(tmp_path / "options.safetensors")
        return tmp_path / "options.safetensors"

    def test_its_options_are_there_from_the_start(self, path: Path) -> None:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", success_probability=1.0), options_file=str(path))
        assert env.bank.filled == (1,)
        observation, _ = env.reset(options={"start": (2, 5)})
        assert env.action_masks().tolist() == [True] * 4 + [False, True, False, False]
        observation, _, _, _, info = env.step(5)
        assert (info["option"]["duration"], info["option"]["termination"]) == (8, "subgoal")
        assert env.concept_features(observation[None]).tolist() == [[10.0, 5.0]]

    def test_the_spec_makes_them_again(self, path: Path) -> None:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"), options_file=path)
        assert env.spec is not None
        again = gym.make(env.spec)
        assert isinstance(again, OptionsWrapper)
        assert again.bank.filled == (1,)

    def test_a_missing_file_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"^There is no options file at .+nowhere\.$"):
            OptionsWrapper(CountingEnv(), options_file=tmp_path / "nowhere")

    def test_a_file_that_does_not_fit_is_an_error(self, path: Path) -> None:
        with pytest.raises(ValueError, match=r"its options choose among 4 primitive actions, this task has 2\.$"):
            OptionsWrapper(CountingEnv(), options_file=path)


class TestMaxRuns:
    """`max_runs` counts runs of one option in one episode."""

    @staticmethod
    def make(max_runs: int | None, **kwargs: Any) -> OptionsWrapper:
        env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", success_probability=1.0, **kwargs), max_runs=max_runs)
        east, west = 3, 2
        cells = Region(np.array([[x, 5.0] for x in range(2, 8)]), np.ones(2), 0.0)
        for action in (east, west):
            policy = TabularPolicy(np.zeros((1, 210)), np.eye(4)[action : action + 1])
            env.bank.add(SubgoalOption(ball(8.0, 5.0), cells, policy))
        return env

    def run(self, env: OptionsWrapper, actions: list[int]) -> list[int]:
        """Which slot each of the actions ran."""
        return [env.step(action)[4]["option"]["index"] for action in actions]

    def test_an_option_that_has_run_so_often_counts_as_empty_until_the_next_episode(self) -> None:
        env = self.make(2)
        for seed in (0, 1):
            env.reset(seed=seed, options={"start": (5, 5)})
            masks = []
            for _ in range(2):
                masks.append(env.action_masks()[4:6].tolist())
                assert env.step(4)[4]["option"]["termination"] == "subgoal"
                env.step(2)  # back into the initiation set
            assert masks == [[True, True], [True, True]]
            assert env.action_masks()[4:6].tolist() == [False, True]
            info = env.step(4)[4]["option"]
            assert (info["index"], info["duration"]) == (-1, 1)
            assert 0 <= int(info["actions"][0]) < 4

    def test_what_may_start_next_keeps_to_it(self) -> None:
        env = self.make(1)
        env.report_availability(True)
        env.reset(seed=0, options={"start": (5, 5)})
        available = env.step(4)[4]["option"]["available"]
        assert available[:, :2].tolist() == [[True, True], [True, True], [False, False]]  # on the way; at the subgoal
        observation, _, _, _, info = env.step(2)  # back into the initiation set
        assert info["option"]["available"][:, :2].tolist() == [[False, True]]
        assert env.available(observation[None])[0, 4:6].tolist() == [True, True]

    def test_another_option_in_the_slot_counts_anew(self) -> None:
        env = self.make(1)
        env.reset(seed=0, options={"start": (5, 5)})
        option = env.bank[0]
        self.run(env, [4, 2])
        env.set_option(0, option)  # one that has grown
        assert not env.action_masks()[4]
        env.set_option(0, None)
        env.set_option(0, option)
        assert env.action_masks()[4]

    def test_without_it_an_option_runs_any_number_of_times(self) -> None:
        env = self.make(None)
        env.reset(seed=0, options={"start": (5, 5)})
        assert self.run(env, [5] * 20) == [1] * 20

    def test_a_step_outside_the_initiation_set_is_no_run(self) -> None:
        env = self.make(1)
        env.reset(seed=0, options={"start": (9, 5)})
        assert self.run(env, [5, 5]) == [1, 1]  # at 9, then at the subgoal

    def test_a_limit_that_is_never_met_changes_nothing(self) -> None:
        actions = np.random.default_rng(0).integers(8, size=500)
        trajectories = []
        for max_runs in (None, 500):
            env = self.make(max_runs)
            env.reset(seed=3)
            trajectories.append([env.step(int(a))[:4] for a in actions])
        assert all(equal(a, b) for steps in zip(*trajectories, strict=True) for a, b in zip(*steps, strict=True))

    def test_the_spec_keeps_it(self) -> None:
        spec = self.make(3).spec
        assert spec is not None
        again = gym.make(spec)
        assert isinstance(again, OptionsWrapper)
        assert again.max_runs == 3

    @pytest.mark.parametrize("max_runs", [0, -1, 1.5])
    def test_out_of_range_is_an_error(self, max_runs: Any) -> None:
        with pytest.raises(ValueError, match=rf"^max_runs must be a whole number, at least 1, .+ got {max_runs}\.$"):
            OptionsWrapper(CountingEnv(), max_runs=max_runs)


class TestArguments:
    @pytest.mark.parametrize(
        "space", [spaces.Box(-1.0, 1.0, (2,)), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)]
    )
    def test_action_space_must_be_discrete(self, space: Any) -> None:
        env = CountingEnv()
        env.action_space = space
        with pytest.raises(TypeError, match=r"^OptionsWrapper needs a Discrete action space, got .+Discretise the act"):
            OptionsWrapper(env)

    def test_actions_must_start_at_0(self) -> None:
        env = CountingEnv()
        env.action_space = spaces.Discrete(3, start=1)
        with pytest.raises(
            ValueError, match=r"^OptionsWrapper needs actions that start at 0, got Discrete\(3, start=1"
        ):
            OptionsWrapper(env)

    @pytest.mark.parametrize("gamma", [0.0, -0.1, 1.0001, float("nan"), float("inf")])
    def test_gamma(self, gamma: float) -> None:
        with pytest.raises(ValueError, match=rf"^gamma must be in \(0, 1\], got {gamma}\.$"):
            OptionsWrapper(CountingEnv(), gamma=gamma)

    def test_max_options(self) -> None:
        with pytest.raises(ValueError, match=r"^max_options must be at least 0, got -1\.$"):
            OptionsWrapper(CountingEnv(), max_options=-1)

    def test_feature_map(self) -> None:
        with pytest.raises(TypeError, match=r"^feature_map must be a function from a batch.+got int\.$"):
            OptionsWrapper(CountingEnv(), feature_map=3)  # type: ignore[arg-type]  # the point of the test
        with pytest.raises(ValueError, match=r"^feature_map must return features of shape \(batch, d\); .+\(1,\)\.$"):
            OptionsWrapper(CountingEnv(), feature_map=lambda obs: np.zeros(len(obs)))

    def test_concept_features(self) -> None:
        env = OptionsWrapper(DictEnv(), feature_map=place_of)
        assert env.concept_features({"place": np.array([[3.0]])}).tolist() == [[3.0]]
        without = OptionsWrapper(DictEnv())
        assert without.feature_kind() is None
        with pytest.raises(
            ValueError, match=r"^There is no default feature map for Dict\(.+pass OptionsWrapper\(env, f"
        ):
            without.concept_features({"place": np.array([[3.0]])})


def test_a_primitive_step_adds_no_more_than_five_scalars_to_its_info() -> None:
    env = OptionsWrapper(CountingEnv(), 3, gamma=0.9)
    env.reset()
    info = env.step(0)[4]
    added = info.pop("option")
    assert info == {"time": 1}
    assert len(added) <= 5
    assert all(isinstance(value, int | float | str) for value in added.values())
