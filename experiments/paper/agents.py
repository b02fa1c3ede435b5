"""The paper's agents: how they are made, are forked, and replay experience."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from experiments.common.agents import wrapper_of
from experiments.paper.learning_on import LearningOn
from experiments.paper.settings import PaperSettings
from sb3_options import MacroQ, OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.option import SubgoalOption


class SingleEnv(DummyVecEnv):
    """`DummyVecEnv` for one environment that makes its infos anew in every step, as `OptionsWrapper` does.

    It hands them out instead of a deep copy, which would take half of the run time, and counts the primitive steps of
    an episode, as a ``Monitor`` would for a tenth of it.

    Attributes:
        step_limit: An episode is cut off at the end of the action that reaches so many primitive steps.
    """

    step_limit = float("inf")
    _steps = 0

    def step_wait(self) -> VecEnvStepReturn:
        """Step, and reset at the end of an episode."""
        observation, reward, terminated, truncated, info = self.envs[0].step(self.actions[0])
        self._steps += info["option"]["duration"] if "option" in info else 1
        truncated = truncated or self._steps >= self.step_limit
        done = terminated or truncated
        info["TimeLimit.truncated"] = truncated and not terminated
        if done:
            info["episode"], self._steps = {"l": self._steps}, 0
            info["terminal_observation"] = observation
            observation, self.reset_infos[0] = self.envs[0].reset()
        return observation[None], np.array([reward]), np.array([done]), [info]


def make_agent(settings: PaperSettings, seed: int, *, slots: bool = True, **world: Any) -> MacroQ:
    """An agent that knows nothing yet, with an empty option slot or without `OptionsWrapper`.

    Args:
        settings: Learning parameters.
        seed: Of agent and environment.
        slots: Whether it can have options.
        world: Arguments of `GridWorld` other than the task of §6.1.
    """
    world = {
        "success_probability": settings.success_probability,
        "goal_reward": settings.goal_reward,
        "max_steps": settings.step_limit,
        **world,
    }

    def make_env() -> gym.Env[Any, Any]:
        env = GridWorld(**world)
        return OptionsWrapper(env, settings.options_per_run, gamma=settings.gamma) if slots else env

    return MacroQ(
        SingleEnv([make_env]),
        learning_rate=settings.step_size,
        gamma=settings.gamma,
        epsilon=settings.epsilon,
        seed=seed,
    )


def world_of(agent: MacroQ) -> GridWorld:
    """The gridworld itself."""
    return cast("GridWorld", wrapper_of(agent).unwrapped)


def fork(agent: MacroQ) -> MacroQ:
    """A copy that goes on from the same state, with the same random numbers to come, and without the option."""
    twin = copy.deepcopy(agent)
    wrapper = wrapper_of(twin)
    wrapper.set_option(0, None)
    wrapper.set_slots(record=False)
    return twin


def discoverer(settings: PaperSettings, seed: int, *, max_new_options: int = 1) -> SubgoalDiscoveryCallback:
    """The library's callback with the paper's settings; with no new options it lets those there are go on learning."""
    callback = LearningOn(
        settings.discovery(), settings.option(), method=settings.method(), max_new_options=max_new_options
    )
    callback.step_size = settings.option_step_size if settings.keep_learning else 0.0
    return callback


class Replay(BaseCallback):
    """Experience replay into the main value function, as much as the option of the same run takes (§6.1).

    The option's value function is initialised by sweeps over the saved steps that began in its input set I, and goes
    on learning once from those of every later trajectory. This does as many backups of the main task, at the same
    trials: of those very steps (partial), or of steps of the same trajectories wherever they began, each chosen with
    the probability that makes the expected number equal.

    Args:
        option: Whose work is to be equalled; the agent itself does not have it.
        saved: The trajectories its initialisation replayed.
        settings: ``replay_order`` and ``keep_learning`` are used.
        whole: Over the whole state space, or only over I.
        sweeps: Through the saved trajectories, at first.
        rng: Chooses steps.

    Attributes:
        backups: How many were made so far.
    """

    def __init__(
        self,
        option: SubgoalOption,
        saved: list[LabelledTrajectory],
        settings: PaperSettings,
        *,
        whole: bool,
        sweeps: int,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        self.option, self.saved, self.settings = option, saved, settings
        self.whole, self.sweeps, self.rng = whole, sweeps, rng
        self.backups = 0

    def _on_training_start(self) -> None:
        wrapper_of(self._agent).set_slots(record=True)
        for _ in range(self.sweeps):
            for labelled in self.saved:
                self._replay(labelled.trajectory, labelled.features)

    def _on_step(self) -> bool:
        trajectory = self.locals["infos"][0].pop("trajectory", None)
        if trajectory is not None and self.settings.keep_learning:
            self._replay(trajectory, wrapper_of(self._agent).concept_features(trajectory.states))
        return True

    @property
    def _agent(self) -> MacroQ:
        return cast("MacroQ", self.model)

    def _replay(self, trajectory: Trajectory, features: FloatArray) -> None:
        began = trajectory.visits[:-1]
        chosen = steps_in_initiation_set(self.option, features)[began]
        if self.whole:
            chosen = self.rng.random(len(began)) < chosen.mean()
        steps = np.flatnonzero(chosen)
        if self.settings.replay_order == "backward":
            steps = steps[::-1]
        cells = trajectory.states.argmax(axis=1)  # type: ignore[union-attr]  # one-hot vectors
        ended = np.zeros(len(began), dtype=bool)
        ended[-1] = trajectory.terminated
        replay(
            self._agent,
            cells[began[steps]].tolist(),
            trajectory.actions[steps].tolist(),
            trajectory.rewards[steps].tolist(),
            cells[trajectory.visits[1:][steps]].tolist(),
            ended[steps].tolist(),
        )
        self.backups += len(steps)


def replay(
    agent: MacroQ,
    began: Sequence[int],
    actions: Sequence[int],
    rewards: Sequence[float],
    led: Sequence[int],
    ended: Sequence[bool],
) -> None:
    """Q-learning of primitive actions from earlier steps, in the given order (experience replay, Lin 1992).

    Args:
        agent: Over a table.
        began: State where each step began, (n,); likewise all others.
        actions: Primitive actions.
        rewards: Of each step.
        led: State where it led.
        ended: Whether nothing follows.
    """
    table = agent.policy.table()
    step_size, n_primitive = cast("float", agent.learning_rate), wrapper_of(agent).n_primitive
    rows: list[list[float]] = table.tolist()  # five times faster to write to than an array
    for state, action, reward, next_state, over in zip(began, actions, rewards, led, ended, strict=True):
        target = reward if over else reward + agent.gamma * max(rows[next_state][:n_primitive])
        rows[state][action] += step_size * (target - rows[state][action])
    table[:] = rows


def steps_in_initiation_set(option: SubgoalOption, features: FloatArray) -> BoolArray:
    """Which states lie in I, the subgoal excepted; from their features (m, d), shape (m,)."""
    return option.initiation_set.contains(features) & ~option.subgoal.contains(features)
