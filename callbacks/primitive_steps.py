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
    check_normalized_rewards,
    check_nothing_above_changes_steps,
    check_replay_buffer,
)
from sb3_options.execution.workers import watch_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import heads
from sb3_options.learning.checks import check_gamma, check_wrapped
from sb3_options.learning.rollout_buffer import option_rollout_buffer
from sb3_options.options.bank import OptionBank

logger = logging.getLogger("sb3_options")


class PrimitiveStepsCallback(BaseCallback):
    """Makes ``num_timesteps``, and with it budget, schedules and every x-axis, count primitive steps.

    SB3 counts calls of ``step``; an option of k primitive steps is one call, so k − 1 are added. A progress bar among
    the other callbacks is advanced too, and the rollout buffer of an on-policy algorithm gets the duration of every
    action. Use it with hand-made options, or with a custom SMDP environment whose actions have durations of their own
    (it leaves ``info["option"] = {"index": -1, "duration": k, "discount": gamma**k}``). `SubgoalDiscoveryCallback` does
    the same, so that it is not needed beside it.

    Raises:
        ValueError: When training starts: the environment reports no durations, or buffer or discount do not fit.
    """

    def _on_training_start(self) -> None:
        self._rollout_buffer = option_rollout_buffer(self.model)
        check_replay_buffer(self.model)
        watch_workers(self.training_env)
        if not any(self.training_env.env_is_wrapped(OptionsWrapper)):
            return  # a custom SMDP environment; its infos are checked in _on_step
        check_wrapped(self.training_env, "The model's environment")
        check_nothing_above_changes_steps(self.training_env)
        check_normalized_rewards(self.model)
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
            self._rollout_buffer.expect(self.locals["rewards"], runs, self.model.get_vec_normalize_env())
        count_inner_steps(self, runs)
        return True


def count_inner_steps(callback: BaseCallback, runs: Sequence[OptionRun]) -> None:
    """Add the primitive steps that SB3 did not count in one call of ``step`` to the model's ``num_timesteps``."""
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
    """Move a ``Monitor`` from above the `OptionsWrapper` to beneath it.

    SB3 puts a ``Monitor`` around an environment that has none. There it would count decisions and sum discounted
    rewards; beneath the options it counts primitive steps and undiscounted rewards. A ``VecMonitor`` cannot be moved,
    and there is a warning.
    """
    if is_vecenv_wrapped(venv, VecMonitor):
        # It records an episode before a callback could correct the last step.
        logger.warning(
            "VecMonitor above OptionsWrapper counts decisions and sums discounted rewards: leave it out and put a "
            "Monitor beneath, as make_vec_env(..., wrapper_class=OptionsWrapper) does."
        )
    inner = venv.unwrapped
    if not isinstance(inner, DummyVecEnv):
        return  # SB3 puts no Monitor around environments in worker processes
    for i, env in enumerate(inner.envs):
        if isinstance(env, Monitor) and isinstance(env.env, OptionsWrapper):
            options = env.env
            env.env, options.env = options.env, env
            inner.envs[i] = options
