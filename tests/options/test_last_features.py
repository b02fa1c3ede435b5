import numpy as np

from sb3_options.density.regions import Region
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy


class Counted:
    """φ that counts how often it is asked."""

    def __init__(self) -> None:
        self.n = 0

    def __call__(self, observations: Observations) -> FloatArray:
        self.n += 1
        return np.asarray(observations, dtype=np.float64)


def option(*points: float) -> SubgoalOption:
    initiation = Region(np.array(points)[:, None], np.ones(1), 0.25)
    return SubgoalOption(
        Region(np.zeros((1, 1)), np.ones(1), 0.25), initiation, TabularPolicy(np.ones((1, 1)), np.eye(2)[:1])
    )


def test_all_options_of_a_bank_ask_once_for_the_features_of_an_observation() -> None:
    counted = Counted()
    bank = OptionBank(2, 3, feature_map=counted)
    for points in ((1.0,), (2.0,), (1.0, 2.0)):
        bank.add(option(*points))
    assert bank.available(np.array([[1.0]])).tolist() == [[True, True, True, False, True]]
    assert bank.available(np.array([[1.0]])).tolist() == [[True, True, True, False, True]]
    assert counted.n == 1
