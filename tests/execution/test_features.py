import copy
import hashlib
from typing import Any
from unittest.mock import MagicMock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import OptionsWrapper
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.execution.concepts import ConceptsInObservation
from sb3_options.execution.features import MAX_FEATURES, Features, flat_size, form_of, signature
from tests.support.helpers import CountingEnv, equal
from tests.support.sb3_helpers import Corridor, places


def resolve(env: gym.Env[Any, Any], feature_map: Any = None) -> Features:
    features = OptionsWrapper(env, feature_map=feature_map).features
    assert features is not None
    return features


def env_with(space: Any) -> gym.Env[Any, Any]:
    env = CountingEnv()
    env.observation_space = space
    return env


@pytest.mark.parametrize(
    ("space", "kind", "observations", "expected"),
    [
        (spaces.Discrete(3), "categorical", [2, 0], [[0, 0, 1], [1, 0, 0]]),
        (spaces.Discrete(3, start=-1), "categorical", [1, -1], [[0, 0, 1], [1, 0, 0]]),
        (spaces.Box(0, 9, (2,), np.float32), "identity", [[3, 4]], [[3, 4]]),
        (spaces.Box(0, 255, (1, 2, 2), np.uint8), "identity", [[[[1, 2], [3, 4]]]], [[1, 2, 3, 4]]),
        (spaces.Box(-np.inf, np.inf, (1,)), "identity", [[5.0]], [[5.0]]),
        (spaces.MultiDiscrete([3, 4]), "identity", [[1, 3]], [[1, 3]]),
        (spaces.MultiBinary(3), "identity", [[1, 0, 1]], [[1, 0, 1]]),
    ],
)
def test_defaults(space: Any, kind: str, observations: Any, expected: Any) -> None:
    features = resolve(env_with(space))
    assert (features.kind, features.size) == (kind, len(expected[0]))
    assert equal(features.map(np.array(observations)), np.array(expected, dtype=np.float64))


def test_the_environments_own_unless_one_is_given() -> None:
    features = resolve(gym.make("sb3_options/TwoRooms-v0"))
    assert (features.kind, features.size) == ("environment", 2)
    assert features.map(np.eye(210)[[0, 22]]).tolist() == [[0, 0], [1, 1]]
    features = resolve(gym.make("sb3_options/TwoRooms-v0"), lambda obs: np.zeros((len(obs), 7)))
    assert (features.kind, features.size) == ("given", 7)
    features = resolve(Corridor("dict"), places)
    assert (features.kind, features.size) == ("given", 1)


def test_a_map_that_refuses_made_up_observations_is_measured_at_the_first_real_one() -> None:
    env = OptionsWrapper(gym.make("sb3_options/TwoRooms-v0", observation="image"))
    assert env.traits.feature_size is None
    env.reset(seed=0)
    assert env.bank.feature_size == 2


def test_a_map_that_refuses_real_observations() -> None:
    env = OptionsWrapper(CountingEnv(), feature_map=MagicMock(side_effect=ValueError("no agent to be seen")))
    with pytest.raises(ValueError, match="no agent to be seen"):
        env.reset(seed=0)


def test_resolving_draws_nothing_from_the_environment() -> None:
    env = CountingEnv()
    env.observation_space.seed(3)
    untouched = copy.deepcopy(env.observation_space)
    resolve(env, lambda obs: np.zeros((len(obs), 1)))
    flat_size(env.observation_space)
    assert env.observation_space.sample() == untouched.sample()


@pytest.mark.parametrize(
    ("space", "named"),
    [
        (spaces.Dict(image=spaces.Box(0, 1, (2,)), mission=spaces.Text(20)), r"\(mission: Text.*MiniGridWrapper"),
        (spaces.Tuple((spaces.Discrete(3), spaces.Box(0, 1, (2,)))), r"\(observation: Tuple.*FlattenObservation"),
        (spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Dict({"c": spaces.Discrete(2)})}), r"\(b: Dict"),
    ],
)
def test_observations_that_stable_baselines3_does_not_take_are_named(space: spaces.Space[Any], named: str) -> None:
    with pytest.raises(ValueError, match=f"Stable-Baselines3 cannot learn from these observations {named}"):
        OptionsWrapper(env_with(space), feature_map=lambda observations: np.zeros((1, 1)))


@pytest.mark.parametrize(
    ("space", "parts"),
    [
        (spaces.Box(0.0, 1.0, (2,)), [b" Box (2,) float32", np.array([0, 0, 1, 1], np.float32).tobytes()]),
        (spaces.Discrete(3, start=1), [b" Discrete(3, start=1)"]),
        (spaces.MultiDiscrete([3, 4]), [b" MultiDiscrete int64 [3, 4] [0, 0]"]),
        (
            spaces.Dict(b=spaces.MultiBinary(3), a=spaces.Tuple((spaces.Discrete(2), spaces.Discrete(5)))),
            [b" Dict ['a', 'b']", b".a Tuple 2", b".a.0 Discrete(2)", b".a.1 Discrete(5)", b".b MultiBinary(3)"],
        ),
    ],
)
def test_the_digest_of_a_space_stays_what_it_is_in_saved_files(space: Any, parts: list[bytes]) -> None:
    digest = hashlib.sha256(b"".join(part + b"\n" for part in parts)).hexdigest()
    assert signature(space, None) == (" ".join(str(space).split()), digest, None)


class _Grouped(gym.Wrapper[Any, Any, Any, Any]):
    """Names features, and which of them belong together."""

    def concept_features(self, observations: Any) -> Any:
        return np.zeros((len(observations), 3))

    def concept_groups(self) -> list[dict[str, Any]]:
        return [{"name": "last", "features": [2]}]


def test_groups_come_from_whoever_has_the_feature_map() -> None:
    env = _Grouped(gym.make("sb3_options/TwoRooms-v0"))
    (group,) = OptionsWrapper(env).traits.feature_groups
    assert (group.name, group.features) == ("last", (2,))
    above = ConceptsInObservation(env, lambda env, info: [0.0, 0.0], 2)
    assert OptionsWrapper(above).traits.feature_groups == ()
    assert OptionsWrapper(env, feature_map=lambda obs: np.zeros((len(obs), 1))).traits.feature_groups == ()
    assert OptionsWrapper(gym.make("sb3_options/TwoRooms-v0")).traits.feature_groups == ()

    class Refusing(_Grouped):
        def concept_features(self, observations: Any) -> Any:
            if observations.any():
                raise ValueError("made up")
            return super().concept_features(observations)

    late = OptionsWrapper(Refusing(CountingEnv()))  # it cannot be asked yet how many features there are
    assert (late.bank.feature_size, [g.features for g in late.traits.feature_groups]) == (None, [(2,)])
    late.reset()
    assert late.bank.feature_size == 3


def test_groups_that_do_not_fit_the_feature_map_are_refused() -> None:
    class Wide(_Grouped):
        def concept_groups(self) -> list[dict[str, Any]]:
            return [{"name": "last", "features": [3]}]

    with pytest.raises(ValueError, match="group 'last' names feature 3, the feature map gives 3"):
        OptionsWrapper(Wide(gym.make("sb3_options/TwoRooms-v0")))


def test_features_of_observations_that_a_wrapper_has_changed_are_refused() -> None:
    """The environment's own φ would make something else of them, in silence."""
    env = gym.make("sb3_options/TwoRooms-v0", observation="xy")
    changed = gym.wrappers.RescaleObservation(env, np.float32(0), np.float32(1))
    with pytest.raises(ValueError, match=r"concept_features of GridWorld is for its own observations, .* leave that"):
        OptionsWrapper(changed)
    OptionsWrapper(changed, feature_map=env.get_wrapper_attr("concept_features"))  # whoever means it says so
    assert OptionsWrapper(gym.wrappers.RecordEpisodeStatistics(env)).traits.feature_kind == "environment"


@pytest.mark.parametrize(
    ("space", "form"),
    [
        (spaces.Discrete(5), ("table", (5,), 0)),
        (spaces.Discrete(5, start=2), ("table", (5,), 2)),
        (spaces.Box(0, 1, (2, 3)), ("vector", (6,), 0)),
        (spaces.Box(0, 255, (40, 36, 3), np.uint8), ("image", (3, 40, 36), 1)),
        (spaces.MultiBinary(7), ("vector", (7,), 0)),
        (spaces.Dict({"a": spaces.Box(0, 1, (2, 3)), "b": spaces.Discrete(9)}), ("vector", (7,), 0)),
    ],
)
def test_what_a_learned_map_knows_of_observations(space: Any, form: Any) -> None:
    assert form_of(space) == form
    features = resolve(env_with(space), "temporal-distance")
    assert isinstance(features.map, LearnedMap)
    assert features[1:] == (LearnedMap.size, "temporal-distance", ())
    assert features.map.encoder.form == form


def test_groups_of_a_given_map_are_its_own() -> None:
    class Grouped:
        __call__ = _Grouped.concept_features
        concept_groups = _Grouped.concept_groups

    (group,) = resolve(env_with(spaces.Box(0, 1, (2,))), Grouped()).groups
    assert (group.name, group.features) == ("last", (2,))


@pytest.mark.parametrize(("n", "kind"), [(MAX_FEATURES, "identity"), (MAX_FEATURES + 1, None)])
def test_the_largest_space_with_a_default(n: int, kind: str | None) -> None:
    for none in (spaces.Dict({"a": spaces.Discrete(2)}), spaces.Box(0, 255, (64, 64, 3), np.uint8)):
        assert OptionsWrapper(env_with(none)).features is None
    for space in (spaces.Box(0, 1, (n,)), spaces.Discrete(n)):
        features = OptionsWrapper(env_with(space)).features
        name = "categorical" if kind and isinstance(space, spaces.Discrete) else kind
        assert (features and features.kind) == name


DIFFERENT: list[Any] = [
    *(spaces.Discrete(4), spaces.Discrete(4, start=1), spaces.MultiDiscrete([4, 4]), spaces.MultiDiscrete([4, 5])),
    *(spaces.Box(0, 1, (2,)), spaces.Box(0, 1, (3,)), spaces.Box(0, 2, (2,)), spaces.Box(-1, 1, (2,))),
    *(spaces.Box(0, 1, (2,), np.float64), spaces.MultiDiscrete([4, 4], start=[1, 0]), spaces.MultiBinary(2)),
    *(spaces.Box(0, 1, (2, 1)), spaces.Box(np.zeros(2, np.float32), np.array([1, 2], np.float32))),
    *(spaces.MultiDiscrete([3] * 2000), spaces.MultiDiscrete([3] * 1000 + [4] + [3] * 999), spaces.Box(0, 1, (2000,))),
    spaces.Box(np.zeros(2000, np.float32), 1 + (np.arange(2000) == 1000).astype(np.float32)),
    *(spaces.Dict({key: spaces.Discrete(n)}) for key in "ab" for n in (2, 3)),
    spaces.Dict({"a": spaces.Dict({"b": spaces.Discrete(2)})}),
    spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Discrete(3)}),
    spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Discrete(2)}),
    spaces.Tuple((spaces.Discrete(2), spaces.Discrete(3))),
    spaces.Tuple((spaces.Discrete(3), spaces.Discrete(2))),
]


def test_signatures_differ_where_spaces_do() -> None:
    told = [signature(space, None) for space in DIFFERENT]
    assert told == [signature(copy.deepcopy(space), None) for space in DIFFERENT]
    assert len({each.digest for each in told}) == len(DIFFERENT)
    assert [each.space for each in told[:1]] == ["Discrete(4)"]
    turned = spaces.Dict({"b": spaces.Discrete(3), "a": spaces.Discrete(2)})
    assert signature(turned, None).digest == signature(DIFFERENT[-4], None).digest
    assert signature(spaces.Discrete(4, seed=3), None) == told[0]
    assert told[0].features is None
    assert signature(DIFFERENT[0], resolve(env_with(DIFFERENT[0]))).features == "categorical"
