"""Every algorithm over `OptionsVecEnv`, on environments of which none can be asked or stepped alone."""

from pathlib import Path
from typing import Any

import pytest
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.vec_grid import VecGridWorld
from sb3_options import MacroQ, OptionDQN, OptionsVecEnv, load_model
from sb3_options.callbacks import CheckpointCallback, IntrinsicRewardCallback, SubgoalDiscoveryCallback
from tests.support.sb3_helpers import FAST_DISCOVERY, RANDOM, SMALL_ROOMS, env_of

N_ENVS = 8
GAMMA = 0.9
ROLLOUTS: dict[str, Any] = {"n_steps": 32}
REPLAY: dict[str, Any] = {"learning_starts": 2000, "buffer_size": 8000, "train_freq": 8, **RANDOM}
ALGORITHMS: list[tuple[type[BaseAlgorithm], dict[str, Any]]] = [
    (A2C, {}),
    (DQN, REPLAY),
    (MaskablePPO, {**ROLLOUTS, "batch_size": 64}),
    (OptionDQN, REPLAY),
    (PPO, {**ROLLOUTS, "batch_size": 64}),
    (QRDQN, REPLAY),
    (TRPO, ROLLOUTS),
]


def make_env(max_options: int = 4) -> OptionsVecEnv:
    return OptionsVecEnv(VecGridWorld(SMALL_ROOMS, N_ENVS, max_steps=150), max_options, gamma=GAMMA)


class Runs(BaseCallback):
    """Counts what environments report, and what they have truly stepped."""

    def __init__(self) -> None:
        super().__init__()
        self.reported = 0
        self.options: list[dict[str, Any]] = []
        self.rows = 0

    def _on_step(self) -> bool:
        self.rows += N_ENVS
        for info in self.locals["infos"]:
            self.reported += info["option"]["duration"]
            if info["option"]["index"] >= 0:
                self.options.append(info["option"])
        return True


@pytest.mark.parametrize(("algorithm", "kwargs"), ALGORITHMS, ids=[a.__name__ for a, _ in ALGORITHMS])
def test_every_algorithm_discovers_options_and_uses_them(algorithm: Any, kwargs: dict[str, Any]) -> None:
    model = algorithm("MlpPolicy", make_env(), gamma=GAMMA, seed=0, policy_kwargs={"net_arch": [32]}, **kwargs)
    _learns(model, 5_000, masked=algorithm in (MaskablePPO, OptionDQN))


def test_a_memory_that_would_see_the_waiting_is_refused() -> None:
    model = RecurrentPPO("MlpLstmPolicy", make_env(), gamma=GAMMA)
    with pytest.raises(ValueError, match="OptionsVecEnv shows the same observation again"):
        model.learn(100, callback=SubgoalDiscoveryCallback())


def test_macro_q_too() -> None:
    _learns(MacroQ(make_env(), gamma=GAMMA, seed=0), 5_000, masked=True)


def _learns(model: BaseAlgorithm, n_timesteps: int, *, masked: bool) -> None:
    discovery, runs = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1), Runs()
    model.learn(n_timesteps, callback=[discovery, runs])
    assert len(discovery.discoveries) == 1
    assert any(run["duration"] > 1 and run["termination"] == "subgoal" for run in runs.options)
    assert all(run["inside"] for run in runs.options) or not masked
    # Steps of options count when these end, and those that run at the end have not.
    assert runs.rows - N_ENVS * 100 <= runs.reported == model.num_timesteps <= runs.rows
    assert len(discovery.history) > 10
    assert sum(episode.steps for episode in discovery.history) <= runs.rows


def test_a_bonus_is_given_once_for_each_primitive_step() -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    bonus, runs = IntrinsicRewardCallback(), Runs()
    model.learn(4_000, callback=[SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1), bonus, runs])
    assert runs.options
    assert sum(bonus.novelty.visits.values()) == runs.reported  # type: ignore[union-attr]  # it counts states


def test_a_saved_model_brings_its_options_along(tmp_path: Path) -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    discovery = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1)
    model.learn(4_000, callback=discovery)
    model.save(tmp_path / "model")
    again = load_model(MaskablePPO, tmp_path / "model", make_env())
    (bank,) = env_of(again).get_attr("bank", [0])
    assert bank.content() == discovery.bank.content()
    again.learn(1_000, callback=SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=0))


def test_demonstrations_get_failures_from_random_actions() -> None:
    random = make_env(0)
    successes = [each for each in random.random_trajectories(400, 3) if each.is_success][:5]
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    settings = {**FAST_DISCOVERY, "min_positive": 2}
    discovery = SubgoalDiscoveryCallback(settings, max_new_options=1, demonstrations=successes)
    model.learn(256, callback=discovery)
    assert discovery.discoveries[0].timestep == 0


def test_checkpoints_are_refused_with_what_to_do_instead(tmp_path: Path) -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    with pytest.raises(ValueError, match="OptionsVecEnv"):
        model.learn(500, callback=[SubgoalDiscoveryCallback(), CheckpointCallback(tmp_path)])
