"""Counting in primitive steps, whatever the algorithm chooses among."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EventCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_options.callbacks.checks import (
    check_gamma,
    check_nothing_above_changes_steps,
    check_replay_buffer,
    check_wrapped,
)
from sb3_options.execution.workers import watch_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import heads
from sb3_options.learning.on_policy import option_rollout_buffer
from sb3_options.learning.rollout_buffer import passage_of
from sb3_options.options.bank import OptionBank

logger = logging.getLogger("sb3_options")


class PrimitiveStepsCallback(BaseCallback):
    """Makes ``num_timesteps``, and with it budget, schedules and every x-axis, count primitive steps.

    SB3 counts calls of ``step``; an option of k primitive steps is one call, so k − 1 are added. A progress bar among
    the other callbacks is moved along, and the rollout buffer of an on-policy algorithm learns how long every action
    took. Use it alone with hand-made options, or with an environment of your own whose actions take different times
    (it leaves ``info["option"] = {"index": -1, "duration": k, "discount": gamma**k}``); `SubgoalDiscoveryCallback`
    does the same.

    Raises:
        ValueError: When training starts: the environment reports no durations, or buffer or discount do not fit.
    """

    def _on_training_start(self) -> None:
        self._rollout_buffer = option_rollout_buffer(self.model)
        check_replay_buffer(self.model)
        watch_workers(self.training_env)
        if not any(self.training_env.env_is_wrapped(OptionsWrapper)):
            return  # its own environment's actions take times of their own; the first step shows it
        check_wrapped(self.training_env, "The model's environment")
        check_nothing_above_changes_steps(self.training_env)
        check_gamma(self.model, self.training_env)
        monitor_primitive_steps(self.training_env)
        if heads.has_heads(self.model.policy):
            bank: OptionBank = self.training_env.get_attr("bank", [0])[0]
            for slot, option in enumerate(bank.slots):
                if option is None:
                    heads.close_head(self.model.policy, bank.n_primitive + slot)

    def _on_step(self) -> bool:
        runs = [OptionRun.from_info(info) for info in self.locals["infos"]]
        if self._rollout_buffer is not None:
            self._rollout_buffer.expect(passage_of(self.locals["rewards"], runs))
        count_inner_steps(self, runs)
        return True


def count_inner_steps(callback: BaseCallback, runs: Sequence[OptionRun]) -> None:
    """Add to the model's ``num_timesteps`` what one call of ``step`` left out."""
    extra = sum(run.duration for run in runs) - len(runs)
    if extra == 0:
        return
    callback.model.num_timesteps += extra
    callback.num_timesteps = callback.model.num_timesteps
    for sibling in all_callbacks(callback.locals.get("callback")):
        if isinstance(sibling, ProgressBarCallback):
            sibling.pbar.update(extra)


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


def monitor_primitive_steps(venv: VecEnv) -> None:
    """Move a ``Monitor`` that stands above the `OptionsWrapper` beneath it.

    SB3 puts a ``Monitor`` around an environment that has none. There it would count decisions and sum discounted
    rewards; beneath the options it counts primitive steps and undiscounted rewards. A ``VecMonitor`` cannot be moved:
    there is a warning.
    """
    if is_vecenv_wrapped(venv, VecMonitor):
        # It writes an episode down before any callback could set the last step right.
        logger.warning(
            "VecMonitor above OptionsWrapper counts decisions and sums discounted rewards: leave it out and put a "
            "Monitor beneath, as make_vec_env(..., wrapper_class=OptionsWrapper) does."
        )
    inner = venv.unwrapped
    if not isinstance(inner, DummyVecEnv):
        return  # worker processes make their own environments, and SB3 puts no Monitor around those
    for i, env in enumerate(inner.envs):
        if isinstance(env, Monitor) and isinstance(env.env, OptionsWrapper):
            options = env.env
            env.env, options.env = options.env, env
            inner.envs[i] = options
