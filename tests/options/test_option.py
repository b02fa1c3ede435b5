import pickle
from typing import Any

import numpy as np
import pytest

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations, flatten
from sb3_options.options.option import Option, SubgoalOption
from sb3_options.options.policies import TabularPolicy
from tests.support.helpers import ball, equal, steady_option, table_option


def subgoal_option(**kwargs: Any) -> SubgoalOption:
    """Reach 3 from {1, 2, 3} on a line, by action 1 everywhere but in 2."""
    initiation = Region(np.array([[1.0], [2.0], [3.0]]), np.ones(1), 0.25)
    policy = TabularPolicy(np.array([[1.0], [2.0]]), np.array([[0.0, 1.0], [1.0, 0.0]]))
    return SubgoalOption(ball(3.0, radius=0.5), initiation, policy, **kwargs)


def test_the_three_functions_of_a_hand_made_option() -> None:
    option = table_option([0, 1, 1], [2, 0, 1], [0.0, 0.25, 1.0])
    observations = np.array([2, 0, 1, 1])
    assert equal(option.initiation(observations), np.array([True, False, True, True]))
    assert equal(option.policy(observations), np.array([1, 2, 0, 0]))
    assert equal(option.termination(observations), np.array([1.0, 0.0, 0.25, 0.25]))


@pytest.mark.parametrize(
    "duration", [0, -3, 1.5, 0.5, True, None, "7", float("nan"), float("inf"), np.float64("-inf"), [1]]
)
@pytest.mark.parametrize("make", [steady_option, subgoal_option])
def test_max_duration_out_of_range(make: Any, duration: Any) -> None:
    text = r"^max_duration must be a whole number of primitive steps, at least 1, got .+\.$"
    with pytest.raises(ValueError, match=text):
        make(max_duration=duration)


@pytest.mark.parametrize("name", ["initiation", "policy", "termination"])
@pytest.mark.parametrize(("returned", "shape"), [(1, r"\(\)"), ([1, 1, 1], r"\(3,\)"), ([[1], [1]], r"\(2, 1\)")])
def test_one_value_per_observation(name: str, returned: Any, shape: str) -> None:
    functions: dict[str, Any] = {k: lambda obs: np.zeros(len(obs)) for k in ("initiation", "policy", "termination")}
    functions[name] = lambda obs: returned
    option = Option(**functions, name="mine")
    message = rf"^{name} of option 'mine' must return one value per observation, shape \(2,\), got shape {shape}\.$"
    with pytest.raises(ValueError, match=message):
        getattr(option, name)(np.zeros((2, 3)))


class TestSubgoalOption:
    observations = np.array([[0.0], [1.0], [1.2], [2.0], [2.5], [3.0], [3.5], [3.6]])

    def test_functions(self) -> None:
        option = subgoal_option(feature_map=flatten)
        # 2.5, 3 and 3.5 are the subgoal; 3.2 would be in I but for that.
        assert option.termination(self.observations).tolist() == [0, 0, 0, 0, 1, 1, 1, 0]
        assert option.initiation(self.observations).tolist() == [False, True, True, True, False, False, False, False]
        assert option.policy(self.observations).tolist() == [1, 1, 1, 0, 0, 0, 0, 0]

    def test_one_at_a_time_and_again_is_the_same(self) -> None:
        asked: list[int] = []

        def counting(observations: Observations) -> FloatArray:
            asked.append(len(observations))
            return flatten(observations)

        together, option = subgoal_option(feature_map=flatten), subgoal_option(feature_map=counting)
        for _ in range(3):
            for i in range(len(self.observations)):
                one = self.observations[i : i + 1]
                assert option.termination(one) == together.termination(self.observations)[i]
                inside = option.initiation(one)
                assert inside == together.initiation(self.observations)[i]
                inside[:] = ~inside  # what a caller does with an answer changes no later one
        assert asked == [1] * len(self.observations)
        assert pickle.loads(pickle.dumps(option))._membership._rows == {}

    def test_without_a_feature_map(self) -> None:
        option = subgoal_option(name="door")
        message = r"^Option 'door' has no feature map: add it to the bank of an OptionsWrapper that has one"
        for function in (option.initiation, option.termination):
            with pytest.raises(ValueError, match=message):
                function(self.observations)

    def test_pickle_leaves_the_feature_map_behind(self) -> None:
        option = subgoal_option(feature_map=lambda obs: flatten(obs), name="door")
        copied = pickle.loads(pickle.dumps(option))
        with pytest.raises(ValueError, match="no feature map"):
            copied.initiation(self.observations)
        again = copied.bind(flatten)
        for function in ("initiation", "policy", "termination"):
            np.testing.assert_array_equal(
                getattr(again, function)(self.observations), getattr(option, function)(self.observations)
            )
        assert option.initiation(self.observations).any()
