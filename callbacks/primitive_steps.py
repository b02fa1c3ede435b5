"""`PrimitiveStepsCallback`: counts primitive steps, whatever actions the algorithm chooses among."""

import logging
import math
from typing import Any, ClassVar

from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback

from sb3_options.callbacks.checks import check_options
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.callbacks.tree import all_callbacks, check_every_step, evaluation_envs
from sb3_options.execution.above import monitor_primitive_steps
from sb3_options.execution.workers import watch_workers
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.families import family_of
from sb3_options.learning.rollout_buffer import SMDPAdvantages, n_decisions, option_rollout_buffer

logger = logging.getLogger("sb3_options")

# Attributes of an on-policy model that hold its last step, with their names in ``collect_rollouts``.
LAST = {"_last_obs": "new_obs", "_last_episode_starts": "dones", "_last_lstm_states": "lstm_states"}


class PrimitiveRollouts:
    """Keeps the rollouts of an on-policy algorithm at about ``n_steps`` primitive steps of each environment.

    SB3 fixes the number of decisions when a rollout starts. It is the number that took ``n_steps`` primitive steps in
    the rollout before, in multiples that fill the minibatches, and at most ``n_steps``. The model's ``n_steps`` holds
    this number only between two rollouts, when SB3 reads it. A model that is saved during a rollout has its original
    ``n_steps``.
    """

    def __init__(self, model: Any, buffer: SMDPAdvantages) -> None:
        self.model = model
        self.buffer = buffer
        self.n_steps: int = buffer.n_primitive_steps or model.n_steps
        buffer.n_primitive_steps = self.n_steps
        batch = getattr(model, "batch_size", None)
        self.multiple = 1 if not batch else batch // math.gcd(batch, buffer.n_envs)
        # Advantages are divided by their spread, and a single one has none.
        self.least = 2 if getattr(model, "normalize_advantage", False) and buffer.n_envs == 1 else 1

    def begin(self) -> None:
        """Restore ``n_steps`` of the model: the rollout that begins has its size."""
        self.model.n_steps = self.n_steps

    def plan_next(self) -> None:
        """Set the size of the next rollout, before the model has learned from the present one."""
        if not self.buffer.waits:
            self.model.n_steps = n_decisions(self.n_steps, self.buffer.durations, self.multiple, self.least)
        self.buffer.next_size = self.model.n_steps

    def end(self) -> None:
        """Let the next training count decisions, unless it sets primitive rollouts."""
        self.model.n_steps = self.buffer.next_size = self.n_steps
        self.buffer.n_primitive_steps = None


class PrimitiveStepsCallback(BaseCallback):
    """Makes ``num_timesteps``, and with it budget, schedules and every x-axis, count primitive steps.

    SB3 counts calls of ``step``. An option of k primitive steps is one call, so the callback adds k − 1. It also
    advances a progress bar among the other callbacks, and gives the rollout buffer of an on-policy algorithm the
    duration of every action. Use it with hand-made options, or with a custom SMDP environment whose actions have
    durations of their own (it leaves ``info["option"] = {"index": -1, "duration": k, "discount": gamma**k}``).
    `SubgoalDiscoveryCallback` does the same, and makes this one superfluous.

    When training starts, network and replay buffer are fitted to the options that the environments hold
    (`OptionInstaller`). Options in the environment of an ``EvalCallback`` are left to the user.

    ``train_freq``, ``target_update_interval`` and ``eval_freq`` of an ``EvalCallback`` still count decisions. So does
    ``n_steps``, unless ``primitive_rollouts`` is set. A rollout may then take many more primitive steps, and on-policy
    training ends in the middle of one when the budget is used up (rounded up to whole rollouts, as if every action were
    one step). The model does not learn from that rollout. No schedule sees a progress below 0. Over `OptionsVecEnv` all
    of these count primitive steps.

    Args:
        primitive_rollouts: Whether ``n_steps`` of an on-policy algorithm counts primitive steps. A rollout then has as
            many decisions as took ``n_steps`` primitive steps in the previous rollout. Otherwise options make rollouts
            longer, and updates rarer.
        verbose: As for any callback.

    Raises:
        ValueError: When training starts: the environment reports no durations, buffer or discount do not fit, or
            environments have different options.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_installer",)

    def __init__(self, verbose: int = 0, *, primitive_rollouts: bool = False) -> None:
        super().__init__(verbose)
        self.primitive_rollouts = primitive_rollouts
        # Set here, because rl-zoo3 also ends trainings that were refused before they started.
        self._rollouts: PrimitiveRollouts | None = None
        self._rollout_buffer: SMDPAdvantages | None = None
        self._installer: OptionInstaller | None = None

    def _on_training_start(self) -> None:
        self._installer = None
        check_every_step(self)
        family_of(self.model).prepare()
        self._start_counting()
        if not any(self.training_env.env_is_wrapped(OptionsWrapper)):
            return  # a custom SMDP environment; its infos are checked in _on_step
        check_options(self.model, self.training_env)
        if self._leads:
            self._installer = OptionInstaller(self.model, self.training_env, None, open_untrained=False)
            for venv in evaluation_envs(self.locals.get("callback")):
                monitor_primitive_steps(venv)

    def _start_counting(self) -> None:
        watch_workers(self.training_env)
        self._has_actors = hasattr(self.training_env.unwrapped, "lost_actors")
        self._normalizer = self.model.get_vec_normalize_env()
        self._rollout_buffer = option_rollout_buffer(self.model)
        self._rollouts = None
        if self.primitive_rollouts and self._rollout_buffer is not None:
            self._rollouts = PrimitiveRollouts(self.model, self._rollout_buffer)
        ours = [c for c in all_callbacks(self.locals.get("callback")) if isinstance(c, PrimitiveStepsCallback)]
        # If there are several, the one that discovers options counts. Its class builds on this module.
        self._leads = max(ours or [self], key=lambda each: hasattr(each, "discoveries")) is self
        self._updates_before = self._n_updates()
        self._budget = math.inf
        if self._rollout_buffer is not None:
            n_steps: int = self.model.n_steps  # type: ignore[attr-defined]  # it has rollouts
            self._rollout_buffer.next_size = n_steps  # an exception may have left a shorter one behind
            # The first rollout of a resumed training may be shorter.
            whole = n_steps if self._rollouts is None else self._rollouts.n_steps
            rollout = whole * self._rollout_buffer.n_envs
            done, total = self.model.num_timesteps, self.model._total_timesteps
            self._budget = done + math.ceil((total - done) / rollout) * rollout

    def _on_step(self) -> bool:
        return self._count(list(map(OptionRun.from_info, self.locals["infos"])))

    def _on_rollout_start(self) -> None:
        if self._rollouts is not None:
            self._rollouts.begin()
        if self._installer is not None:
            self._installer.on_rollout_start()

    def _on_rollout_end(self) -> None:
        if self._rollouts is not None:
            self._rollouts.plan_next()
        if self._installer is not None:
            self._installer.on_rollout_end()

    def _count(self, runs: list[OptionRun]) -> bool:
        """Count one step of every environment, and return whether training goes on."""
        if self._leads:
            self._count_inner_steps(runs)
            if self._has_actors:
                self.logger.record("time/lost_actors", self.training_env.unwrapped.lost_actors)  # type: ignore[attr-defined]  # a RayVecEnv
        buffer = self._rollout_buffer
        if buffer is None:
            return True
        buffer.expect(self.locals["rewards"], runs, self._normalizer)
        # The model still learns from a rollout that this step completes.
        goes_on = self.model.num_timesteps < self._budget or buffer.pos + 1 == buffer.buffer_size
        if not goes_on:  # SB3 does not tell the model where the environments are if training ends inside a rollout
            for name, value in LAST.items():
                if value in self.locals:
                    setattr(self.model, name, self.locals[value])
        return goes_on

    def _count_inner_steps(self, runs: list[OptionRun]) -> None:
        """Count the primitive steps that SB3 and its progress bar did not count."""
        extra = math.ceil(sum([run.duration for run in runs])) - len(runs)  # a user's durations may be fractions
        self.model.num_timesteps += extra
        self.num_timesteps = self.model.num_timesteps
        # A last option may end beyond the budget. Schedules would then see a progress below 0.
        self.model._total_timesteps = max(self.model._total_timesteps, self.num_timesteps)
        for each in all_callbacks(self.locals.get("callback")) if extra else ():
            if isinstance(each, ProgressBarCallback):
                each.pbar.update(extra)

    def _on_training_end(self) -> None:
        if self._rollouts is not None:
            self._rollouts.end()
        if self._installer is not None:
            self._installer.on_training_end()
        buffer = self._rollout_buffer
        if buffer is not None and self.num_timesteps >= self._budget and self._n_updates() == self._updates_before:
            logger.warning(
                "Training ended before its first update: its rollouts of n_steps=%d decisions take more primitive "
                "steps than total_timesteps allows. Choose a smaller n_steps, or train for longer.",
                buffer.buffer_size,
            )

    def _n_updates(self) -> int:
        return int(getattr(self.model, "_n_updates", 0))
