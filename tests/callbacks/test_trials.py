"""Options on trial: what an episode does without, what is closed, and what a closed option leaves behind."""

from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_options import MacroQ, Option, OptionDQN, OptionReplayBuffer, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.trials import OptionTrials
from sb3_options.execution.interruption import Interruption
from sb3_options.execution.trials import OptionTrial, TrialReport, TrialSettings
from sb3_options.learning import heads
from tests.support.helpers import CountingEnv, steady_option, table_option
from tests.support.sb3_helpers import FAST_DISCOVERY, RANDOM, TINY, Corridor, env_of, optioned_rooms

GAMMA = 0.9
QUICK: dict[str, Any] = {"withhold": 0.4, "look_every": 5, "window": 60, "success_window": 5, "patience": 5}
N_PRIMITIVE = 4


def withholding_all(option: Option) -> OptionsWrapper:
    wrapped = OptionsWrapper(CountingEnv(3, truncate_at=20), 2, gamma=GAMMA)
    wrapped.bank.add(option)
    wrapped.withhold_options({0: 1.0}, [0])
    wrapped.reset(seed=0)
    return wrapped


class TestAnEpisodeWithout:
    def test_masks_the_option(self) -> None:
        wrapped = withholding_all(steady_option(1))
        assert wrapped.action_masks().tolist() == [True, True, True, False, False]
        assert wrapped.available(np.zeros((1, 1)))[0].tolist() == [True, True, True, True, False]
        wrapped.withhold_options({}, [0])
        wrapped.reset()
        assert wrapped.action_masks().tolist() == [True, True, True, True, False]

    def test_runs_one_step_of_the_options_policy_where_no_values_are_known(self) -> None:
        info = withholding_all(steady_option(1)).step(3)[4]["option"]
        assert (info["index"], info["duration"], info["termination"]) == (-1, 1, "primitive")
        assert info["actions"].tolist() == [1]

    def test_runs_the_best_primitive_in_the_place_of_a_greedy_choice(self) -> None:
        wrapped = withholding_all(steady_option(1))
        wrapped.set_interruption(Interruption(lambda s: np.array([0.0, 1.0, 2.0, 3.0, -9.0])))
        assert wrapped.step(3)[4]["option"]["actions"].tolist() == [2]

    def test_runs_a_random_primitive_in_the_place_of_an_exploratory_choice(self) -> None:
        wrapped = withholding_all(steady_option(1))
        wrapped.set_interruption(Interruption(lambda s: np.array([0.0, 1.0, 2.0, 1.5, -9.0])))
        drawn = []
        for _ in range(300):
            _, _, _, over, info = wrapped.step(3)
            drawn.append(int(info["option"]["actions"][0]))
            if over:
                wrapped.reset()
        assert all(drawn.count(a) > 60 for a in range(3))

    def test_reports_at_its_end_what_it_returned(self) -> None:
        wrapped = withholding_all(steady_option(1))
        for _ in range(19):
            assert "option_trial" not in wrapped.step(0)[4]
        report: TrialReport = wrapped.step(0)[4]["option_trial"]
        assert report["withheld"] == {0: True}
        assert report["outcome"] == pytest.approx(sum(GAMMA**t * (t + 1) for t in range(20)))

    def test_with_it_the_report_says_that_it_was_not_withheld(self) -> None:
        wrapped = withholding_all(steady_option(1, max_duration=20))
        wrapped.withhold_options({0: 0.0}, [0])
        wrapped.reset()
        report: TrialReport = wrapped.step(3)[4]["option_trial"]
        assert report["withheld"] == {0: False}
        assert report["outcome"] == pytest.approx(sum(GAMMA**t * (t + 1) for t in range(20)))

    def test_draws_nothing_from_what_the_environment_draws(self) -> None:
        def walk(wrapped: OptionsWrapper) -> list[int]:
            wrapped.reset(seed=3)
            return [wrapped.step(4)[4]["option"]["duration"] for _ in range(15)]  # of the option that ends at random

        plain = OptionsWrapper(CountingEnv(3, truncate_at=20), 2, gamma=GAMMA)
        plain.bank.add(steady_option(1))
        withholding = withholding_all(steady_option(1))
        for wrapped in (plain, withholding):
            wrapped.bank.add(table_option([True] * 40, [1] * 40, [0.5] * 40), 1)
        withholding.withhold_options({0: 1.0}, [0])
        assert walk(plain) == walk(withholding)
        assert len(set(walk(plain))) > 1


def scripted(action: int, seed: int, episodes: int = 400) -> int | None:
    """An agent that goes right, or, in a third of its choices, takes an option; the episode that closed it."""
    rng = np.random.default_rng(seed)
    wrapped = OptionsWrapper(Corridor("discrete", limit=80), 1, gamma=GAMMA)
    wrapped.bank.add(table_option([True] * 12, [action] * 12, [False] * 12, max_duration=6))
    venv = DummyVecEnv([lambda: wrapped])
    venv.seed(seed)
    trials = OptionTrials(venv, TrialSettings(), seed)
    venv.reset()
    ended = 0
    while ended < episodes:
        chosen = 2 if rng.random() < 1 / 3 else int(rng.random() < 0.9)
        _, _, dones, infos = venv.step(np.array([chosen]))
        if dones[0]:
            ended += 1
            success = not infos[0]["TimeLimit.truncated"]
            if trials.episode_ended(infos[0].get("option_trial"), success=success, filled=[0]):
                return ended
    return None


def test_a_detour_is_closed_and_a_short_cut_is_not() -> None:
    """Over 4 seeds each: an option six steps back, and one six steps ahead."""
    detours = [scripted(0, seed) for seed in range(4)]
    assert sum(c is not None for c in detours) == 4
    assert [scripted(1, seed) for seed in range(4)] == [None] * 4


class TestOptionTrials:
    def trials(self, **settings: Any) -> OptionTrials:
        venv = DummyVecEnv([lambda: OptionsWrapper(CountingEnv(), 2, gamma=GAMMA)])
        return OptionTrials(venv, TrialSettings(**{"success_window": 4, "patience": 10, **settings}), 0)

    def shares(self, trials: OptionTrials) -> dict[int, float]:
        withholding = trials.venv.get_attr("_withholding")[0]
        return {} if withholding is None else withholding.shares

    def test_begin_once_episodes_succeed(self) -> None:
        trials = self.trials()
        for success in (True, False, False, True):
            assert self.shares(trials) == {}
            trials.episode_ended(None, success=success, filled=[1])
        assert self.shares(trials) == {1: 0.1}
        for _ in range(3):
            trials.episode_ended(None, success=False, filled=[1])
        assert self.shares(trials) == {}

    def test_begin_at_last_where_none_succeeds(self) -> None:
        trials = self.trials()
        for _ in range(9):
            trials.episode_ended(None, success=False, filled=[0])
        assert self.shares(trials) == {}
        trials.episode_ended(None, success=False, filled=[0])
        assert self.shares(trials) == {0: 0.1}

    def test_begin_anew_for_another_option(self) -> None:
        trials = self.trials()
        report: TrialReport = {"withheld": {0: True}, "outcome": 1.0}
        trials.episode_ended(report, success=True, filled=[0])
        first = trials.trials[0]
        trials.episode_ended(report, success=True, filled=[])
        trials.episode_ended(report, success=True, filled=[0])
        assert trials.trials[0] is not first


def dragged(kind: str = "box") -> OptionsWrapper:
    """The corridor, in which every place is worth more than those to its left, with an option that leads left."""
    env = OptionsWrapper(Corridor(kind), 2, gamma=GAMMA)
    env.bank.add(steady_option(0, max_duration=20, name="drags"))
    return env


@pytest.mark.parametrize("algorithm", [DQN, QRDQN, OptionDQN, PPO, A2C])
def test_a_harmful_option_leaves_nothing_behind(algorithm: Any) -> None:
    """Closed in every environment, in the network, its optimizer and the buffer; and the slot is free for another."""
    off_policy = algorithm in (DQN, QRDQN, OptionDQN)
    intra_option = {"replay_buffer_class": OptionReplayBuffer, "replay_buffer_kwargs": {"intra_option": True}}
    replay = TINY | RANDOM | intra_option
    # A policy that learns would leave the option alone by itself.
    kwargs = replay if off_policy else {"n_steps": 64, "seed": 0, "device": "cpu", "learning_rate": 1e-9}
    if algorithm is PPO:
        kwargs["n_epochs"] = 1
    model = algorithm("MlpPolicy", DummyVecEnv([dragged, dragged]), gamma=GAMMA, **kwargs)
    callback = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=0, interruption=False, trial=QUICK)
    model.learn(200, callback=callback)
    assert callback.bank.filled == (0,)
    model.learn(5000, callback=callback)
    assert [(c.slot, c.why) for c in callback.closed] == [(0, "harmful")]
    assert len(callback.bank) == 0
    assert all(bank.filled == () for bank in env_of(model).get_attr("bank"))
    action = 2
    assert heads.is_closed(model.policy, action)
    for layer, outputs in heads.option_outputs(model.policy):
        assert not layer.weight[heads.rows_of(layer, outputs, action)].any()
    if off_policy:
        buffer = model.replay_buffer
        assert (buffer.actions[: buffer.size()] < action).all()
        assert not buffer.consistency.consistent.any()


class Choices(BaseCallback):
    """Keeps every choice of MacroQ, whether the option was withheld where it was made, and what ran."""

    def __init__(self) -> None:
        super().__init__()
        self.chosen: list[tuple[int, bool]] = []
        self._now: list[bool] = []

    def _on_step(self) -> bool:
        self.chosen += [(int(a), withheld) for a, withheld in zip(self.locals["actions"], self._now, strict=True)]
        self._look()
        return True

    def _on_training_start(self) -> None:
        self._look()

    def _look(self) -> None:
        self._now = [bool(slots) for slots in self.training_env.env_method("withheld_slots")]


def test_macro_q_does_without_a_withheld_option() -> None:
    model = MacroQ(DummyVecEnv([lambda: dragged("discrete"), lambda: dragged("discrete")]), gamma=GAMMA, seed=0)
    callback = SubgoalDiscoveryCallback(max_new_options=0, trial={**QUICK, "alpha": 1e-9})
    choices = Choices()
    model.learn(3000, callback=[callback, choices])
    withheld = [action for action, is_withheld in choices.chosen if is_withheld]
    assert len(withheld) > 500
    assert 2 not in withheld
    assert sum(action == 2 for action, _ in choices.chosen) > 50


def test_macro_q_carries_out_a_verdict_when_the_episode_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    verdicts = iter([None, None, "harmful"])
    monkeypatch.setattr(OptionTrial, "add", lambda trial, **episode: next(verdicts, None))
    model = MacroQ(dragged("discrete"), gamma=GAMMA, seed=0)
    callback, choices = SubgoalDiscoveryCallback(max_new_options=0, trial=QUICK), Choices()
    closed_after: list[int] = []

    class Closed(BaseCallback):
        def _on_step(self) -> bool:
            if callback.closed and not closed_after:
                closed_after.append(len(choices.chosen))
            return True

    model.learn(3000, callback=[callback, choices, Closed()])
    before, after = np.split([action for action, _ in choices.chosen], closed_after)
    assert (before == 2).sum() > 5
    assert len(after) > 1000
    assert (after != 2).all()
    assert not model.policy.table()[:, 2].any()
    assert env_of(model).get_attr("bank")[0].filled == ()


def test_its_slot_is_filled_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a verdict at once, in the place of what the statistics would say much later."""
    verdicts = iter(["harmful"])
    monkeypatch.setattr(OptionTrial, "add", lambda trial, **episode: next(verdicts, None))
    env = optioned_rooms(1)
    env.bank.add(steady_option(3, max_duration=5))
    model = DQN("MlpPolicy", env, gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)
    callback = SubgoalDiscoveryCallback(FAST_DISCOVERY, max_new_options=1, trial=QUICK)
    model.learn(5000, callback=callback)
    assert [(d.slot, d.episode > callback.closed[0].episode) for d in callback.discoveries] == [(0, True)]


def test_by_default_nothing_is_withheld() -> None:
    model = DQN("MlpPolicy", dragged(), gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)
    model.learn(1000, callback=SubgoalDiscoveryCallback(max_new_options=0))
    assert env_of(model).get_attr("_withholding") == [None]


def test_momentum_does_not_move_a_closed_head() -> None:
    model = DQN("MlpPolicy", optioned_rooms(2), gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, **TINY | RANDOM)
    model.learn(500)
    heads.close_head(model.policy, N_PRIMITIVE)
    heads.forget_moments(model.policy, N_PRIMITIVE)
    layer = heads.option_outputs(model.policy)[0][0]
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.grad = torch.zeros_like(parameter)
    before = layer.weight.detach().clone()
    model.policy.optimizer.step()
    assert torch.equal(layer.weight[N_PRIMITIVE], before[N_PRIMITIVE])
    assert not torch.equal(layer.weight[0], before[0])


def test_settings_are_checked_when_the_callback_is_made() -> None:
    with pytest.raises(ValueError, match=r"^TrialSettings: withhold should be less than 1, got 2$"):
        SubgoalDiscoveryCallback(trial={"withhold": 2})
