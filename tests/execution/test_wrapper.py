import copy
import itertools
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from sb3_options.embedding.learned_map import LearnedMap
from tests.options.banks import along_row_5
from tests.support.helpers import CountingEnv, equal, random_state, steady_option, table_option
from tests.support.sb3_helpers import TAXI

GRIDWORLDS = [f"sb3_options/{name}-v0" for name in ("TwoRooms", "FourRooms", "KeyDoor")]
ENVS: list[tuple[str, dict[str, Any]]] = [
    *((env_id, {"observation": kind}) for env_id, kind in itertools.product(GRIDWORLDS, ("onehot", "xy", "image"))),
    (TAXI, {}),
    ("CartPole-v1", {}),
]
env_ids = pytest.mark.parametrize(
    ("env_id", "kwargs"), ENVS, ids=[f"{i.removeprefix('sb3_options/')}-{k.get('observation', '')}" for i, k in ENVS]
)


@env_ids
def test_without_options_it_is_the_environment_itself_bit_for_bit(env_id: str, kwargs: dict[str, Any]) -> None:
    bare, wrapped = gym.make(env_id, **kwargs), OptionsWrapper(gym.make(env_id, **kwargs))
    assert wrapped.observation_space == bare.observation_space
    n_actions = int(bare.action_space.n)  # type: ignore[attr-defined]  # Discrete
    actions = np.random.default_rng(1).integers(n_actions, size=3_000)
    assert all(equal(a, b) for a, b in zip(bare.reset(seed=7), wrapped.reset(seed=7), strict=True))
    episodes = 0
    for action in actions:
        *expected, info = bare.step(action)
        *got, wrapped_info = wrapped.step(action)
        option = wrapped_info.pop("option")
        assert option == {"index": -1, "duration": 1, "discount": 0.99, "gamma": 0.99, "termination": "primitive"}
        assert all(equal(a, b) for a, b in zip(expected, got, strict=True))
        assert equal(info, wrapped_info)
        if expected[2] or expected[3]:
            episodes += 1
            seed = episodes if episodes % 3 == 0 else None
            assert all(equal(a, b) for a, b in zip(bare.reset(seed=seed), wrapped.reset(seed=seed), strict=True))
    assert episodes > 0
    assert random_state(bare) == random_state(wrapped)


def test_an_empty_slot_runs_the_primitive_of_its_number() -> None:
    inner = CountingEnv(n_actions=2)
    env = OptionsWrapper(inner, max_options=5, gamma=0.5)
    env.reset(seed=0)
    for slot in range(5):
        observation, reward, _, _, info = env.step(2 + slot)
        about = info["option"]
        assert (observation.tolist(), reward) == ([slot + 1], slot + 1)
        assert (about["index"], about["duration"], about["discount"]) == (-1, 1, 0.5)
        assert about["termination"] == "primitive"
        assert about["actions"].tolist() == inner.actions[-1:] == [slot % 2]


@env_ids
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(in|ax)imum value is -?infinity")
def test_checks_of_gymnasium_and_sb3(env_id: str, kwargs: dict[str, Any]) -> None:
    for wrap in (lambda env: env, OptionsWrapper):
        check_env(wrap(gym.make(env_id, **kwargs)), skip_render_check=True)
        sb3_check_env(wrap(gym.make(env_id, **kwargs)))


@pytest.mark.parametrize(("env_id", "kwargs"), ENVS[:1] + ENVS[-2:])
def test_spec_makes_the_wrapper_again(env_id: str, kwargs: dict[str, Any]) -> None:
    def flat_sum(observations: Any) -> Any:
        return np.asarray(observations, dtype=np.float64).reshape(len(observations), -1).sum(axis=1, keepdims=True)

    env = OptionsWrapper(gym.make(env_id, **kwargs), max_options=3, gamma=0.5, feature_map=flat_sum)
    again = gym.make(env.spec)  # type: ignore[arg-type]  # there is one
    assert isinstance(again, OptionsWrapper)
    assert (again.action_space, again.gamma, again.bank.max_options) == (env.action_space, 0.5, 3)
    assert again.traits.feature_kind == "given"
    assert equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


def test_its_arguments_are_recorded_as_they_are(tmp_path: Any) -> None:
    """A feature map may be a method of the environment, which a copy of the map would copy too."""

    class Uncopied:
        def __call__(self, observations: Any) -> Any:
            return np.zeros((len(observations), 3))

        def __deepcopy__(self, memo: Any) -> Any:
            raise RuntimeError("copied")

    file = tmp_path / "options.safetensors"
    OptionsWrapper(CountingEnv(), 2, feature_map=Uncopied()).bank.save(file)
    given: dict[str, Any] = {"max_options": 2, "gamma": 1.0, "feature_map": Uncopied(), "options_file": file}
    given |= {"max_runs": 3, "check_finite": True}
    env = OptionsWrapper(CountingEnv(), **given)
    assert env._saved_kwargs == given
    assert (env.gamma, env.bank.observation_size, env.bank.feature_size) == (1.0, 1, 3)


def test_whether_an_option_ends_is_drawn_from_the_seed() -> None:
    """β = 1/2. Before a reset has a seed, all environments draw alike."""

    def durations(seed: int | None) -> list[int]:
        env = OptionsWrapper(CountingEnv())
        env.bank.add(table_option([1] * 1000, [0] * 1000, [0.5] * 1000))
        env.reset(seed=seed)
        return [env.step(2)[4]["option"]["duration"] for _ in range(40)]

    assert durations(None) == durations(None)
    assert durations(1) == durations(1) != durations(2)
    assert set(durations(None)) > {1, 2}


def test_several_slots_are_filled_and_emptied_at_once_and_what_was_set_is_kept() -> None:
    env, option, other = OptionsWrapper(CountingEnv()), steady_option(), steady_option(1)
    env.set_slots(options={0: option, 1: other, 3: option}, record=True)
    env.set_slots(options={0: None, 1: None, 2: other, 3: other})
    assert env.bank.slots == (None, None, other, other)
    assert (env.slot_state.options, env.slot_state.record) == ({0: None, 1: None, 2: other, 3: other}, True)


def test_a_learned_map_is_what_it_is_told_to_be() -> None:
    one, two = (OptionsWrapper(CountingEnv(), feature_map="temporal-distance") for _ in range(2))
    learned: Any = one.bank.feature_map
    assert (one.traits.feature_kind, one.traits.feature_size) == ("temporal-distance", LearnedMap.size)
    learned.scale[:] = 2.0
    two.set_slots(learned_map=learned.arrays())
    seen = np.array([[3.0], [5.0]])
    np.testing.assert_array_equal(two.concept_features(seen), one.concept_features(seen))


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_alike(how: Any) -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0"))
    env.bank.add(along_row_5(10.0, 0, 10, 3))
    env.reset(seed=0, options={"start": (2, 5)})
    twin = how(env)
    for action in (3, 4, 5, 6, 4, 5):
        left, right = env.step(action), twin.step(action)
        assert equal(left[0], right[0])
        assert equal(left[4], right[4])
    assert env.action_space == twin.action_space


def test_an_environment_that_masks_its_own_actions_goes_on_doing_so() -> None:
    class Masked(CountingEnv):
        def action_masks(self) -> list[bool]:
            return [self.time % 2 == 0, True]

    env = OptionsWrapper(Masked(), 2)
    env.bank.add(steady_option())
    env.reset()
    assert (env.action_masks().tolist(), str(env.action_masks().dtype)) == ([True, True, True, False], "bool")
    env.step(1)
    assert env.action_masks().tolist() == [False, True, False, False]
    env.step(1)
    assert env.action_masks().tolist() == [True, True, True, False]


def test_action_masks_and_options_need_a_reset() -> None:
    env = OptionsWrapper(CountingEnv())
    env.bank.add(steady_option())
    with pytest.raises(gym.error.ResetNeeded, match=r"^action_masks\(\) needs a current observation: call reset"):
        env.action_masks()
    with pytest.raises(gym.error.ResetNeeded, match=r"^step\(\) needs a current observation: call reset"):
        env.step(2)


@pytest.mark.parametrize(("max_options", "action"), [(2, -1), (2, 4), (2, 100), (0, 2)])
def test_no_such_action(max_options: int, action: int) -> None:
    env = OptionsWrapper(CountingEnv(), max_options)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"^action must be between 0 and {1 + max_options}, got {action}\.$"):
        env.step(action)
    assert env.unwrapped.time == 0  # type: ignore[attr-defined]  # of CountingEnv


def test_an_environment_that_uses_the_name_itself_is_refused() -> None:
    env = OptionsWrapper(CountingEnv(step=lambda env, _: (np.zeros(1), 0.0, False, False, {"option": "left"})))
    env.bank.add(steady_option())
    env.reset(seed=0)
    for action in (0, 2):
        with pytest.raises(ValueError, match=r'^The environment has an info.+"option"\].* of its own.+another name'):
            env.step(action)


def test_says_what_runs_while_it_runs() -> None:
    said: list[str] = []

    def step(inner: CountingEnv, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        said.append(env.running_option())
        return np.array([float(inner.time)]), 0.0, False, False, {}

    env = OptionsWrapper(CountingEnv(step=step), 2)
    env.bank.add(steady_option(max_duration=2, name="forwards"), 1)
    env.reset()
    for action in (0, 3, 1, 2):  # a primitive, the option, a primitive, an empty slot
        env.step(action)
    assert said == ["primitive action", *["option 1: forwards"] * 2, "primitive action", "primitive action"]
