"""The study of demonstrations."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO

from experiments.demonstrations.__main__ import Study, draw
from experiments.demonstrations.conditions import ARMS, LOSS_DECAY, DemonstrationLoss, run
from experiments.demonstrations.experts import expert_of
from experiments.demonstrations.tasks import TASKS
from sb3_options import OptionsWrapper, record_demonstrations
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.cloning import Imitation
from sb3_options.envs import GridWorld
from sb3_options.envs.minigrid import make

RIGHT = 3


@pytest.mark.parametrize(
    ("task", "longest"),
    [
        ("MiniGrid-ObstructedMaze-1Dl-v0", 40),
        ("MiniGrid-LockedRoom-v0", 80),
        ("MiniGrid-ObstructedMaze-2Dlh-v0", 80),
        ("BabyAI-KeyCorridorS3R3-v0", 150),
        ("BabyAI-UnlockToUnlock-v0", 80),
    ],
)
def test_experts_succeed(task: str, longest: int) -> None:
    env = make(task, mission=False)
    shown = record_demonstrations(env, expert_of(env), 4, seed=1)
    assert sum(bool(each.is_success) for each in shown) >= 3
    assert min(map(len, shown)) <= longest


@pytest.mark.parametrize("task", ["TwoRooms", "FourRooms", "Taxi", "Taxi, one stop"])
def test_experts_of_small_tasks_take_a_quarter_of_the_steps_of_a_slow_success(task: str) -> None:
    of = TASKS[task]
    env = of.make()
    shown = record_demonstrations(env, of.expert(env, 0.0, 0), 60, seed=1)
    assert all(each.terminated for each in shown)
    assert of.within is not None
    assert np.mean(list(map(len, shown))) == pytest.approx(of.within / 4, rel=0.15)
    random = of.expert(env, 1.0, 0)
    assert {random(env.observation_space.sample()) for _ in range(200)} == set(range(env.action_space.n))  # type: ignore[attr-defined]


@pytest.mark.parametrize("arm", ["options, cloning", "DQN, options, cloning", "DQN"])
def test_an_arm_learns_from_what_it_is_shown(monkeypatch: pytest.MonkeyPatch, arm: Any) -> None:
    monkeypatch.setitem(TASKS, "TwoRooms", replace(TASKS["TwoRooms"], frames=1_500))
    monkeypatch.setattr("experiments.demonstrations.conditions.EPISODES", 5)
    monkeypatch.setattr("sb3_options.callbacks.cloning.UPDATES", 300)
    result = run("TwoRooms", arm, 10, 0.0, 0)
    shows = arm != "DQN"
    assert bool(result["options"]) == shows
    assert (result["demonstrations"] > 200) == shows
    assert result["success"] > 0.5 or not shows


def test_an_expert_errs_as_often_as_it_is_told() -> None:
    env = make("MiniGrid-LockedRoom-v0", mission=False)
    env.reset(seed=0)
    right, noisy = (expert_of(env, noise, seed=3) for noise in (0.0, 0.5))
    wrong = sum(right(None) != noisy(None) for _ in range(200))
    assert 60 < wrong < 110  # one of seven random actions is right


def test_a_run_that_did_not_learn_is_beyond_the_edge_of_the_picture() -> None:
    task = "MiniGrid-LockedRoom-v0"
    study = Study(out=Path(), tasks=(task,), arms=("options, cloning", "cloning"))
    learned: dict[str, list[int | None]] = {"options, cloning": [10_000, 20_000], "cloning": [30_000, None]}
    results: Any = {f"{task}: {arm}": [{"learned": frames} for frames in of] for arm, of in learned.items()}
    (axes,) = draw(study, results).axes
    with_options, without = (np.column_stack([line.get_xdata(), line.get_ydata()]) for line in axes.lines)
    assert with_options[-2:, 0].tolist() == [10_000, 20_000]
    assert without[without[:, 0] <= axes.get_xlim()[1], 1].max() == 0.5


def test_the_demonstration_loss_is_in_every_gradient_until_training_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Updates of PPO's own are too small to matter. Without the loss the policy stays as it was, with it the
    demonstrations become more probable."""
    env = OptionsWrapper(GridWorld("S.G", max_steps=20), 0, gamma=0.9)
    shown = record_demonstrations(env, lambda _: RIGHT, 5, seed=0)
    assert all(each.is_success for each in shown)
    likely = []
    for weight in (0.0, 1.0):
        monkeypatch.setattr("experiments.demonstrations.conditions.LOSS_WEIGHT", weight)
        discovery = SubgoalDiscoveryCallback(demonstrations=shown, clone=False, max_new_options=0)
        loss = DemonstrationLoss(discovery, shown)
        model = MaskablePPO(
            "MlpPolicy", env, 0.01, gamma=0.9, seed=0, n_steps=32, batch_size=32, n_epochs=1, max_grad_norm=1e-9
        )
        model.learn(32 * 8, [discovery, loss])
        likely.append(math.exp(-Imitation(model, discovery.bank, shown).loss().item()))
        assert loss.weight == pytest.approx(weight * LOSS_DECAY**7)
        assert not model.policy.optimizer._optimizer_step_pre_hooks
    assert likely[0] == pytest.approx(0.25, abs=0.02)
    assert likely[1] > 0.35


@pytest.mark.slow
def test_a_cloned_policy_with_options_succeeds_before_it_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    task = "BabyAI-KeyCorridorS3R3-v0"
    monkeypatch.setitem(TASKS, task, replace(TASKS[task], frames=20_000))
    result = run(task, ARMS[0], 20, 0.0, 0)
    assert len(result["options"]) >= 3
    assert result["demonstrations"] > 1000
    assert result["success"] > 0.1
