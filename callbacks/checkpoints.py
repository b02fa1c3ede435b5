"""`CheckpointCallback` and `load_checkpoint`: training that a killed process does not end."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_options.callbacks import checkpoint_state
from sb3_options.callbacks.tree import all_callbacks, check_every_step, evaluation_envs
from sb3_options.checked import whole
from sb3_options.checkpoints import environments, models
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.checkpoints.tree import State

logger = logging.getLogger("sb3_options")


class EndedAtCheckpointError(Exception):
    """Training has ended where `CheckpointCallback` was asked to end it."""


class CheckpointCallback(BaseCallback):
    """Writes everything that training is to the disk, from where `load_checkpoint` lets it go on as if never ended.

    A checkpoint is written at the start of a rollout, the first of them before the first step. Each holds the model
    with its optimizer and its replay buffer, the callbacks beside this one, the environments in mid-episode and every
    random generator; docs/concepts/checkpoints.md says what cannot be in it. The last two are kept.

    Args:
        folder: Of the checkpoints.
        freq: Primitive steps between two of them, at least 1.
        end_when: Asked at the start of every rollout but the first; once it says yes, a checkpoint is written there,
            training ends, and ``learn`` raises `EndedAtCheckpointError`. None never does.
        verbose: 1 says when training goes on from one.

    Raises:
        ValueError: When training starts: something cannot be in a checkpoint, or the folder has those of another
            training.
    """

    STATE = ("_last",)

    def __init__(
        self,
        folder: str | os.PathLike[str],
        freq: int = 10_000,
        *,
        end_when: Callable[[], bool] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.folder = CheckpointFolder(folder)
        self.freq = freq
        self.end_when = end_when
        self._there: int | None = None
        self._resumed: State | None = None
        self._last: int | None = None

    def resume_from(self, state: State) -> None:
        """Let the next training go on from a state, as `load_checkpoint` reads it."""
        self._resumed = state

    def _on_training_start(self) -> None:
        check_every_step(self)
        self._rollouts = 0
        self._log_interval: int | None = self.locals.get("log_interval")
        models.check(self.model)
        self._root: BaseCallback | None = self.locals.get("callback")
        self._check_folder()
        # What cannot be in a checkpoint is refused now. Before its first step a model has just reset its environments.
        environments.prepare(self.training_env, just_reset=self.model.num_timesteps == 0)
        for venv in self._evaluated():
            environments.prepare(venv)
        checkpoint_state.check(self._root)

    def _check_folder(self) -> None:
        """Refuse a folder with checkpoints of more steps than there are: the newest would be another training's."""
        there, now = max((int(file.stem) for file in self.folder), default=0), self.model.num_timesteps
        if self._resumed is None and there > now:
            raise ValueError(
                f"{self.folder.path} holds a checkpoint of {there:,} primitive steps, of another training, and this "
                f"one begins at {now:,}. Choose another folder, or remove that one; or go on with that training: "
                "load_checkpoint(folder, model, callbacks), with the callbacks that learn() is given."
            )

    def _init_callback(self) -> None:
        if self._resumed is not None and self._resumed["model"]["class"] == type(self.model).__name__:
            models.prepare(self.model, self._resumed["model"])

    def _on_rollout_start(self) -> None:
        now = self.model.num_timesteps
        if self._resumed is not None:
            state, self._resumed = self._resumed, None
            try:
                self._put_back(state)
            except Exception as error:
                self.model.num_timesteps = 0  # what is put back by halves is not to be saved
                if isinstance(error, ValueError):
                    raise
                what = f"{type(error).__name__}: {' '.join(str(error).split())}"
                raise ValueError(f"The checkpoint does not fit what is trained here: {what}") from error
            self._there = self.model.num_timesteps
        elif (self._last is None or now - self._last >= self.freq) and self._may_end():
            self._last = now
            self._save()
        began = self.model.num_timesteps > 0
        if self.end_when is not None and began and self._may_end() and self.end_when():
            self._end()
        self._rollouts += 1

    def _may_end(self) -> bool:
        """Whether training that goes on from here is the training that was not cut off.

        SB3 counts ``log_interval`` of an on-policy algorithm from the start of ``learn``.
        """
        interval = self._log_interval if isinstance(self.model, OnPolicyAlgorithm) else None
        return interval is None or self._rollouts % interval == 0

    def _save(self, then: str = "training goes on") -> None:
        now = self.model.num_timesteps
        try:
            self.folder.save(now, self.state(), growing=models.growing(self.model))
        except OSError as error:
            logger.warning("No checkpoint could be written, %s: %s", then, error)
        else:
            self._there = now

    def _end(self) -> None:
        """End training here. Later checkpoints come where they would have come without it."""
        if self._there != self.model.num_timesteps:
            self._save("training ends without")
        assert self._root is not None  # this callback is in it
        self._root.on_training_end()
        raise EndedAtCheckpointError

    def _on_step(self) -> bool:
        return True

    def state(self) -> State:
        """Everything that training is, at the start of a rollout."""
        return {
            "callbacks": checkpoint_state.get_states(self._root),
            "environments": [environments.get_state(venv) for venv in (self.training_env, *self._evaluated())],
            "model": models.get_state(self.model),
            "logged": models.logged(self.model.logger),
            "event_files": models.event_file_sizes(self.model.logger),
            "random": models.random_states(),
        }

    def _put_back(self, state: State) -> None:
        model = self.model
        before = model.num_timesteps
        checkpoint_state.set_states(self._root, state["callbacks"])  # first: options go into the environments
        trained, *evaluated = state["environments"]
        failures = environments.set_state(self.training_env, trained)
        for venv, there in zip(self._evaluated(), evaluated, strict=True):
            environments.set_state(venv, there)  # an evaluation begins with a reset, wherever the episode was
        models.set_state(model, state["model"])
        if failures:
            logger.warning(
                "The episodes under way cannot go on (%s): all environments begin a new one here, and training is not "
                "what it would have been.",
                "; ".join(failures),
            )
            models.begin_episodes(model)
        models.set_logged(model.logger, state["logged"])
        models.cut_event_files(model.logger, state["event_files"])
        for callback in all_callbacks(self._root):
            if isinstance(callback, ProgressBarCallback):
                callback.pbar.update(model.num_timesteps - before)
        models.set_random_states(state["random"])  # last: nothing of the above has drawn then
        if self.verbose:
            print(f"Going on after {model.num_timesteps:,} primitive steps.")

    def _evaluated(self) -> list[VecEnv]:
        return evaluation_envs(self._root)


def load_checkpoint(
    folder: str | os.PathLike[str], model: BaseAlgorithm, callback: BaseCallback | Sequence[BaseCallback]
) -> int:
    """Let the next ``learn`` of a model go on from the newest whole checkpoint, as if it had never ended.

    Model, environments and callbacks must be made as they were made for the training that ended, and ``learn`` must be
    called as it was called then: it sets everything up, and when its first rollout starts all of it is put back.

    ::

        load_checkpoint("checkpoints", model, callbacks)
        model.learn(100_000, callbacks)

    Args:
        folder: Of a `CheckpointCallback`.
        model: As it was made at first.
        callback: What is passed to ``learn``; a `CheckpointCallback` is among it.

    Returns:
        The primitive steps that the checkpoint has taken.

    Raises:
        FileNotFoundError: There is no checkpoint.
        ValueError: No checkpoint is whole, it is of another model, or there is no `CheckpointCallback`.
    """
    models.check(model)
    root = callback if isinstance(callback, BaseCallback) else CallbackList(list(callback))
    own = [each for each in all_callbacks(root) if isinstance(each, CheckpointCallback)]
    if not own:
        raise ValueError("load_checkpoint needs a CheckpointCallback among the callbacks: it puts everything back.")
    file, state = CheckpointFolder(folder).newest()
    try:
        there, steps = state["model"]["class"], state["model"]["counters"]["num_timesteps"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{file} is no checkpoint of a training: {error!r}") from error
    if not whole(steps, 0):
        raise ValueError(f"{file} is no checkpoint of a training: num_timesteps={steps!r}")
    if there != type(model).__name__:
        raise ValueError(f"The checkpoint is of {there}, the model is {type(model).__name__}.")
    own[0].resume_from(state)
    return int(steps)
