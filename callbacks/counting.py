"""Counting in primitive steps: what SB3 and its progress bar did not count."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.rollout_buffer import SMDPAdvantages, n_decisions

Schedule: TypeAlias = Callable[[float], float]
"""A function of the remaining progress, 1 … 0."""

SCHEDULES = ("lr_schedule", "clip_range", "clip_range_vf")  # attributes of SB3 models that hold schedules


def count_inner_steps(callback: BaseCallback, runs: Sequence[OptionRun]) -> None:
    """Add the primitive steps that SB3 did not count in one call of ``step`` to the model's ``num_timesteps``."""
    extra = math.ceil(sum([run.duration for run in runs])) - len(runs)  # a user's durations may be fractions
    if extra == 0:
        return
    callback.model.num_timesteps += extra
    callback.num_timesteps = callback.model.num_timesteps
    for sibling in all_callbacks(callback.locals.get("callback")):
        if isinstance(sibling, ProgressBarCallback):
            sibling.pbar.update(extra)


class PrimitiveRollouts:
    """Keeps the rollouts of an on-policy algorithm at about ``n_steps`` primitive steps of each environment.

    SB3 fixes the number of decisions when a rollout starts: as many as would have taken so long in the one before, in
    multiples that fill the minibatches, never more than ``n_steps``. SB3 reads ``n_steps`` before a rollout starts, and
    only between two it is the number of decisions: whoever saves the model in a rollout saves what it was made with.
    """

    def __init__(self, model: Any, buffer: SMDPAdvantages) -> None:
        self.model, self.buffer = model, buffer
        self.n_steps: int = buffer.n_primitive_steps or model.n_steps
        buffer.n_primitive_steps = self.n_steps
        batch = getattr(model, "batch_size", None)
        self.multiple = 1 if not batch else batch // math.gcd(batch, buffer.n_envs)
        # Advantages are divided by their spread, and a single one has none.
        self.least = 2 if getattr(model, "normalize_advantage", False) and buffer.n_envs == 1 else 1

    def begin(self) -> None:
        """Put ``n_steps`` back: the rollout that begins has its size."""
        self.model.n_steps = self.n_steps

    def plan_next(self) -> None:
        """Set the size of the next rollout; the present one is still to be learned from."""
        self.model.n_steps = n_decisions(self.n_steps, self.buffer.durations, self.multiple, self.least)
        self.buffer.next_size = self.model.n_steps

    def end(self) -> None:
        """Let the next training count decisions, unless it is told otherwise."""
        self.model.n_steps = self.buffer.next_size = self.n_steps
        self.buffer.n_primitive_steps = None


def clip_schedules(model: BaseAlgorithm) -> dict[str, Schedule]:
    """Let no schedule of a model see a progress below 0, which an option makes of it that ends beyond the budget."""
    stock = {name: schedule for name in SCHEDULES if callable(schedule := getattr(model, name, None))}
    for name, schedule in stock.items():
        setattr(model, name, _clipped(schedule))
    return stock


def _clipped(schedule: Schedule) -> Schedule:
    return lambda progress_remaining: schedule(max(progress_remaining, 0.0))


def all_callbacks(root: BaseCallback | None) -> Iterator[BaseCallback]:
    """Every callback in the tree that ``learn`` was given."""
    if root is None:
        return
    yield root
    children: list[BaseCallback | None] = []
    if isinstance(root, CallbackList):
        children += root.callbacks
    if isinstance(root, EventCallback):
        children += [root.callback, getattr(root, "callback_on_new_best", None)]
    if not isinstance(root, ConvertCallback):
        for child in children:
            yield from all_callbacks(child)


def check_every_step(callback: BaseCallback) -> None:
    """Refuse a callback inside another one, which may call it now and then, as ``EveryNTimesteps`` does."""
    called: list[BaseCallback | None] = [callback.locals.get("callback")]
    for each in called:
        if isinstance(each, CallbackList):
            called += each.callbacks
    if called[0] is not None and callback not in called:
        name = type(callback).__name__
        raise ValueError(
            f"{name} is inside another callback, and has to see every step: pass it to learn() itself, "
            f"model.learn(..., callback=[..., {name}()])."
        )


def evaluation_envs(root: BaseCallback | None) -> list[VecEnv]:
    """The environments of every ``EvalCallback`` in the tree that ``learn`` was given."""
    return [each.eval_env for each in all_callbacks(root) if isinstance(each, EvalCallback)]
