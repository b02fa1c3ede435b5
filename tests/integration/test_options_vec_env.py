"""Every algorithm over `OptionsVecEnv`, on environments of which none can be asked or stepped alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from benchmarks.vec_grid import VecGridWorld
from sb3_options import MacroQ, OptionDQN, OptionsVecEnv, load_model
from sb3_options.callbacks import (
    CheckpointCallback,
    IntrinsicRewardCallback,
    PrimitiveStepsCallback,
    SubgoalDiscoveryCallback,
)
from tests.support.helpers import CountingEnv, steady_option
from tests.support.sb3_helpers import FAST_DISCOVERY, RANDOM, SMALL_ROOMS, env_of

N_ENVS = 8
GAMMA = 0.9
ROLLOUTS: dict[str, Any] = {"n_steps": 32}
REPLAY: dict[str, Any] = {"learning_starts": 2000, "buffer_size": 8000, "train_freq": 8, **RANDOM}
ALGORITHMS: list[tuple[type[BaseAlgorithm], dict[str, Any]]] = [
    (A2C, {}),
    (MacroQ, {}),
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
    if algorithm is not MacroQ:
        kwargs = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [32]}, **kwargs}
    model = algorithm(env=make_env(), gamma=GAMMA, seed=0, **kwargs)
    discovery, runs = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1), Runs()
    model.learn(5_000, callback=[discovery, runs])
    assert len(discovery.discoveries) == 1
    assert any(run["duration"] > 1 and run["termination"] == "subgoal" for run in runs.options)
    assert all(run["inside"] for run in runs.options) or algorithm not in (MaskablePPO, OptionDQN, MacroQ)
    # Steps of options count when these end, and those that run at the end have not.
    assert runs.rows - N_ENVS * 100 <= runs.reported == model.num_timesteps <= runs.rows
    assert len(discovery.history) > 10
    assert sum(episode.steps for episode in discovery.history) <= runs.rows


def test_a_memory_that_would_see_the_waiting_is_refused() -> None:
    model = RecurrentPPO("MlpLstmPolicy", make_env(), gamma=GAMMA)
    with pytest.raises(ValueError, match="OptionsVecEnv shows the same observation again"):
        model.learn(100, callback=SubgoalDiscoveryCallback())


def test_a_bonus_is_given_once_for_each_primitive_step() -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    bonus, runs = IntrinsicRewardCallback(), Runs()
    model.learn(3_000, callback=[SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1), bonus, runs])
    assert runs.options
    assert sum(bonus.novelty.visits.values()) == runs.reported  # type: ignore[union-attr]  # it counts states


@pytest.mark.parametrize("kind", ["counts", "rnd", "noveld", "e3b"])
def test_a_bonus_survives_steps_in_which_every_environment_waits(kind: Any) -> None:
    venv = OptionsVecEnv(DummyVecEnv([lambda: CountingEnv(2, truncate_at=60)]), 1, gamma=GAMMA)
    venv.set_slots(options={0: steady_option(1, max_duration=20)})
    model = MaskablePPO("MlpPolicy", venv, gamma=GAMMA, seed=0, n_steps=32, batch_size=32)
    bonus = IntrinsicRewardCallback(kind)
    model.learn(600, callback=[PrimitiveStepsCallback(primitive_rollouts=True), bonus])
    assert bonus.scale is not None
    assert np.isfinite(bonus.scale.std)
    assert model.n_steps == 32


def test_gradient_steps_keep_their_pace_per_primitive_step() -> None:
    venv = OptionsVecEnv(DummyVecEnv([lambda: CountingEnv(2, truncate_at=60)] * 2), 1, gamma=GAMMA)
    venv.set_slots(options={0: steady_option(1, max_duration=20)})
    model = OptionDQN(
        "MlpPolicy", venv, gamma=GAMMA, seed=0, learning_starts=0, train_freq=1, gradient_steps=1, **RANDOM
    )
    runs = Runs()
    model.learn(3000, callback=[PrimitiveStepsCallback(), runs])
    assert len(runs.options) > 5
    assert model._n_updates == pytest.approx(model.num_timesteps / 2, rel=0.02)


def test_stacked_frames_above_are_refused() -> None:
    model = MaskablePPO("MlpPolicy", VecFrameStack(make_env(), 2), gamma=GAMMA)
    with pytest.raises(ValueError, match="VecFrameStack above OptionsVecEnv"):
        model.learn(100, callback=SubgoalDiscoveryCallback())


def test_a_saved_model_brings_its_options_along(tmp_path: Path) -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    discovery = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1)
    model.learn(3_000, callback=discovery)
    model.save(tmp_path / "model")
    again = load_model(MaskablePPO, tmp_path / "model", make_env())
    (bank,) = env_of(again).get_attr("bank", [0])
    assert bank.content() == discovery.bank.content()
    again.learn(256, callback=SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=0))


def test_demonstrations_get_failures_from_random_actions() -> None:
    random = make_env(0)
    walks = random.random_trajectories(20, 100, 3)
    assert len(walks) == 20
    assert {len(each) for each in walks if each.truncated} == {100}
    assert sum(each.truncated for each in walks) >= 5  # the first 20 to end would be successes alone
    successes = [each for each in random.random_trajectories(100, 100, 3) if each.is_success][:5]
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    settings = {**FAST_DISCOVERY, "min_positive": 2}
    discovery = SubgoalDiscoveryCallback(settings, max_new_options=1, demonstrations=successes)
    model.learn(256, callback=discovery)
    assert discovery.discoveries[0].timestep == 0


def test_checkpoints_are_refused_with_what_to_do_instead(tmp_path: Path) -> None:
    model = MaskablePPO("MlpPolicy", make_env(), gamma=GAMMA, seed=0, n_steps=32, batch_size=64)
    with pytest.raises(ValueError, match="OptionsVecEnv"):
        model.learn(500, callback=[SubgoalDiscoveryCallback(), CheckpointCallback(tmp_path)])
