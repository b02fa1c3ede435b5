"""n-step returns over options against returns that are worked out from the primitive steps alone."""

from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_options import OptionReplayBuffer
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.learning.replay_buffer import OptionReplayBufferSamples
from tests.learning.test_replay_buffer import GAMMA, assert_holds, buffer_for, corridors, fill, optioned, place_in
from tests.support.sb3_helpers import Row


class Decision(NamedTuple):
    """An augmented action and its primitive steps."""

    action: int
    steps: list[Any]
    row: int


def episodes_of(
    venv: VecEnv, buffer: OptionReplayBuffer, n_steps: int, rng: np.random.Generator
) -> list[list[Decision]]:
    """Step every environment, and say which decisions followed each other."""
    logs = cast("list[list[Any]]", venv.get_attr("log"))
    before = [len(log) for log in logs]
    open_: list[list[Decision]] = [[] for _ in logs]
    ended: list[list[Decision]] = []
    chosen = cast("list[list[int]]", venv.get_attr("chosen"))
    n_before = [len(c) for c in chosen]
    written = fill(venv, buffer, n_steps, rng)
    row = 0
    for t in range(n_steps):
        rows = 0
        for i, log in enumerate(logs):
            action = chosen[i][n_before[i] + t]
            steps = _run_of(log, before[i]) if action == 2 else log[before[i] : before[i] + 1]
            before[i] += len(steps)
            stored = steps[0].action if action == 3 else action
            open_[i].append(Decision(stored, steps, row + rows))
            rows += 1 + (len(steps) if action == 2 and buffer.macro_q else 0)
            if steps[-1].terminated or steps[-1].truncated:
                ended.append(open_[i])
                open_[i] = []
        assert rows == len(written[t])
        row += rows
    return [*ended, *(decisions for decisions in open_ if decisions)]


def _run_of(log: list[Any], at: int) -> list[Any]:
    """The primitive steps of `RIGHT` from a place."""
    run: list[Any] = []
    inside = 2 <= place_in(log[at].state) < 8
    while True:
        step = log[at + len(run)]
        run.append(step)
        place = place_in(step.next_state)
        if step.terminated or step.truncated or not (inside and 2 <= place < 8) or len(run) == 4:
            return run


def expected(episodes: list[list[Decision]], n: int, *, macro_q: bool) -> dict[int, Row]:
    """The returns of all rows, by row."""
    returns = {}
    for episode in episodes:
        for i, first in enumerate(episode):
            later = [d.steps for d in episode[i + 1 :]]
            returns[first.row] = _sum(first.action, [first.steps, *later][:n])
            if first.action == 2 and macro_q:
                for j, step in enumerate(first.steps):
                    inside = [[s] for s in first.steps[j:]]
                    returns[first.row + 1 + j] = _sum(step.action, [*inside, *later][:n])
    return returns


def _sum(action: int, decisions: list[list[Any]]) -> Row:
    steps = [step for decision in decisions for step in decision]
    rewards = sum(GAMMA**t * step.reward for t, step in enumerate(steps))
    first, last, discount = steps[0], steps[-1], GAMMA ** len(steps)
    return Row(place_in(first.state), action, rewards, discount, place_in(last.next_state), last.terminated)


def assert_samples(buffer: OptionReplayBuffer, rows: list[int], returns: list[Row]) -> None:
    assert_holds(cast("OptionReplayBufferSamples", buffer._get_samples(np.array(rows))), returns)


@pytest.mark.parametrize("macro_q", [True, False])
@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize(("kind", "n"), [("box", 1), ("box", 2), ("box", 5), ("dict", 3), ("image", 3)])
def test_returns_are_those_of_the_primitive_steps(
    kind: str, n: int, n_envs: int, macro_q: bool, rng: np.random.Generator
) -> None:
    venv = corridors(kind, n_envs)
    buffer = buffer_for(venv, 3000, n_steps=n, macro_q=macro_q)
    episodes = episodes_of(venv, buffer, 400 // n_envs, rng)
    returns = expected(episodes, n, macro_q=macro_q)
    assert len(episodes) > 10
    assert len({round(r.discount, 6) for r in returns.values()}) > 3
    assert sorted(returns) == list(range(buffer.size()))
    assert_samples(buffer, sorted(returns), [returns[row] for row in sorted(returns)])


@pytest.mark.parametrize("size", [3, 7, 37])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_the_same_where_the_oldest_rows_are_overwritten(size: int, n_envs: int, rng: np.random.Generator) -> None:
    for n_steps in range(5, 45, 3):
        venv = corridors("box", n_envs)
        buffer = buffer_for(venv, size, n_steps=3)
        returns = expected(episodes_of(venv, buffer, n_steps, rng), 3, macro_q=True)
        n = len(returns)
        kept = range(max(0, n - size), n)
        whole = [row for row in kept if row == kept[0] or returns[row].discount]
        assert_samples(buffer, [row % size for row in whole], [returns[row] for row in whole])


def test_a_reset_in_mid_episode_ends_the_returns_before_it(rng: np.random.Generator) -> None:
    venv = corridors("box", limit=1000)
    buffer = buffer_for(venv, 3000, n_steps=1000, macro_q=False)
    resets = []
    for _ in range(100):
        fill(venv, buffer, 2, rng)
        resets.append(buffer.pos)
    before, after = np.array(resets[:-1]) - 1, np.array(resets[:-1])
    led, began = buffer._next_observations[""][before], buffer._observations[""][after]
    elsewhere = (led != began).any(axis=1) & (buffer.dones[before] == 0)
    assert elsewhere.sum() > 20
    assert buffer._successors is not None
    assert (buffer._successors.following[before[elsewhere]] == -1).all()
    assert (buffer._successors.following[before - 1] == before).any()


def test_a_removed_option_leaves_no_return_across_its_rows(rng: np.random.Generator) -> None:
    venv = corridors("box")
    buffer = buffer_for(venv, 3000, n_steps=4)
    returns = expected(episodes_of(venv, buffer, 300, rng), 4, macro_q=True)
    removed = [row for row, r in returns.items() if r.action == 2]
    buffer.forget_action(2)
    samples = cast("OptionReplayBufferSamples", buffer._get_samples(np.arange(buffer.size())))
    assert not (samples.actions == 2).any()
    assert buffer._successors is not None
    assert (buffer._successors.following[removed] == -1).all()
    assert not np.isin(buffer._successors.following, removed).any()
    unharmed = [row for row in returns if not any(row <= other < row + 12 for other in removed)]
    assert len(unharmed) > 20
    assert_samples(buffer, unharmed, [returns[row] for row in unharmed])


@pytest.mark.parametrize("n", [1, 3])
def test_a_buffer_of_one_option_alone_is_emptied_with_its_successors(n: int) -> None:
    info = {"option": {"index": 0, "duration": 2, "discount": 0.81, "termination": "subgoal"}}
    buffer = OptionReplayBuffer(10, spaces.Box(0.0, 1.0, (1,)), spaces.Discrete(3), "cpu", macro_q=False, n_steps=n)
    for place in (0.0, 0.5):
        here, there = np.full((1, 1), place), np.full((1, 1), place + 0.5)
        buffer.add(here, there, np.array([2]), np.ones(1), np.zeros(1), [info])
    buffer.forget_action(2)
    assert buffer.size() == 0
    if buffer._successors is not None:  # with n = 3
        assert (buffer._successors.following == -1).all()
        assert buffer._successors.newest(0) is None


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_buffer_of_one_environment_goes_on_in_a_model_of_three(n_steps: int, tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {
        "gamma": GAMMA, "replay_buffer_class": OptionReplayBuffer, "learning_starts": 20, "buffer_size": 500,
        "replay_buffer_kwargs": {"n_steps": n_steps},
    }  # fmt: skip
    model = DQN("MlpPolicy", optioned("box"), **kwargs)
    model.learn(60, callback=PrimitiveStepsCallback())
    model.save_replay_buffer(tmp_path / "rows.pkl")
    other = DQN("MlpPolicy", DummyVecEnv([lambda: optioned("box")] * 3), **kwargs)
    other.load_replay_buffer(tmp_path / "rows.pkl")
    stored = cast("OptionReplayBuffer", other.replay_buffer).size()
    other.learn(60, callback=PrimitiveStepsCallback())
    assert cast("OptionReplayBuffer", other.replay_buffer).size() >= stored + 60


def test_n_steps_that_sb3_does_not_pass_on_is_refused() -> None:
    with pytest.warns(UserWarning, match="`n_steps=3` is ignored"):
        model = DQN("MlpPolicy", optioned("box"), gamma=GAMMA, n_steps=3, replay_buffer_class=OptionReplayBuffer)
    with pytest.raises(ValueError, match=r"pass DQN\(..., replay_buffer_kwargs=\{'n_steps': 3\}\) instead"):
        model.learn(10, callback=PrimitiveStepsCallback())
