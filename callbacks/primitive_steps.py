"""`PrimitiveStepsCallback`: counting in primitive steps, whatever the algorithm chooses among."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback

from sb3_options.callbacks.checks import (
    check_normalized_rewards,
    check_nothing_above_changes_steps,
    check_replay_buffer,
)
from sb3_options.callbacks.counting import count_inner_steps, monitor_primitive_steps
from sb3_options.execution.workers import watch_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import heads
from sb3_options.learning.checks import check_gamma, check_wrapped
from sb3_options.learning.rollout_buffer import option_rollout_buffer
from sb3_options.options.bank import OptionBank


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
                action = bank.n_primitive + slot
                if option is None:
                    heads.close_empty(self.model, slot, bank.n_primitive)
                elif heads.is_closed(self.model.policy, action):
                    heads.open_head(self.model.policy, action, bank.n_primitive)

    def _on_step(self) -> bool:
        runs = [OptionRun.from_info(info) for info in self.locals["infos"]]
        if self._rollout_buffer is not None:
            self._rollout_buffer.expect(self.locals["rewards"], runs, self.model.get_vec_normalize_env())
        count_inner_steps(self, runs)
        return True
