"""`CheckpointCallback` and `load_checkpoint`: resume training after its process was killed."""

import logging
import os
from collections.abc import Callable, Sequence

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

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
    """Saves the whole state of training, so that `load_checkpoint` can resume it as if it had never ended.

    A checkpoint is written at the start of a rollout, the first one before the first step. It holds the model with its
    optimizer and replay buffer, the other callbacks, the environments in mid-episode and every random generator.
    docs/concepts/checkpoints.md lists what it cannot hold. The last two checkpoints are kept.

    Args:
        folder: Folder of the checkpoints.
        freq: Primitive steps between two checkpoints, at least 1.
        end_when: Function that is called at the start of every rollout but the first. Once it returns True, a
            checkpoint is written, training ends, and ``learn`` raises `EndedAtCheckpointError`. None never ends
            training.
        verbose: 1 prints when training resumes from a checkpoint.

    Raises:
        ValueError: When training starts: a checkpoint cannot hold something, or the folder has checkpoints of another
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
        """Resume the next training from a state that `load_checkpoint` has read."""
        self._resumed = state

    def _on_training_start(self) -> None:
        check_every_step(self)
        self._rollouts = 0
        self._log_interval: int | None = self.locals.get("log_interval")
        models.check(self.model)
        self._root: BaseCallback | None = self.locals.get("callback")
        self._check_folder()
        # Refuse now what a checkpoint cannot hold. Before its first step a model has just reset its environments.
        environments.prepare(self.training_env, just_reset=self.model.num_timesteps == 0)
        for venv in evaluation_envs(self._root):
            environments.prepare(venv)
        checkpoint_state.check(self._root)

    def _check_folder(self) -> None:
        """Refuse a folder with a checkpoint of more steps than this training has taken: it is of another training."""
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
                self.model.num_timesteps = 0  # a half-restored model must not be saved
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
        """Return whether training resumed from here would equal training that was never cut off.

        SB3 counts the ``log_interval`` of an on-policy algorithm from the start of ``learn``.
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
        """End training here. Later checkpoints are written where they would have been anyway."""
        if self._there != self.model.num_timesteps:
            self._save("training ends without")
        assert self._root is not None  # this callback is in it
        self._root.on_training_end()
        raise EndedAtCheckpointError

    def _on_step(self) -> bool:
        return True

    def state(self) -> State:
        """Return the whole state of training at the start of a rollout."""
        venvs = (self.training_env, *evaluation_envs(self._root))
        return {
            "callbacks": checkpoint_state.get_states(self._root),
            "environments": [environments.get_state(venv) for venv in venvs],
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
        for venv, there in zip(evaluation_envs(self._root), evaluated, strict=True):
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
        models.set_random_states(state["random"])  # last: the code above may draw random numbers
        if self.verbose:
            print(f"Going on after {model.num_timesteps:,} primitive steps.")


def load_checkpoint(
    folder: str | os.PathLike[str], model: BaseAlgorithm, callback: BaseCallback | Sequence[BaseCallback]
) -> int:
    """Let the next ``learn`` of a model resume from the newest whole checkpoint, as if training had never ended.

    Make model, environments and callbacks as for the training that ended, and call ``learn`` in the same way. The
    checkpoint is restored when its first rollout starts.

    ::

        load_checkpoint("checkpoints", model, callbacks)
        model.learn(100_000, callbacks)

    Args:
        folder: Folder of a `CheckpointCallback`.
        model: Model as it was made at first.
        callback: Callbacks that are passed to ``learn``, with a `CheckpointCallback` among them.

    Returns:
        The primitive steps that were taken before the checkpoint.

    Raises:
        FileNotFoundError: There is no checkpoint.
        ValueError: No checkpoint is whole, the checkpoint is of another model, or there is no `CheckpointCallback`.
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
