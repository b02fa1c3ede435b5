"""`SubgoalDiscoveryCallback` for rl-zoo3."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback
from sb3_options.callbacks.summaries import save_or_warn
from sb3_options.callbacks.tree import evaluation_envs
from sb3_options.options.archive import NAME
from sb3_options.zoo import ZooOptionsWrapper


class ZooDiscoveryCallback(SubgoalDiscoveryCallback):
    """Discovers options, and keeps them in the folder of the run that rl-zoo3 trains, beside the model.

    There `ZooOptionsWrapper` finds them when the run is played. Everything else is `SubgoalDiscoveryCallback`, whose
    arguments it takes.

    Args:
        *args: Of `SubgoalDiscoveryCallback`.
        save_path: Another place for the file.
        **kwargs: Of `SubgoalDiscoveryCallback`.

    Raises:
        ValueError: When training starts, if the environment is not wrapped in `ZooOptionsWrapper`.
    """

    def __init__(self, *args: Any, save_path: str | os.PathLike[str] | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.save_path = save_path

    def _on_training_start(self) -> None:
        if all(self.training_env.env_is_wrapped(ZooOptionsWrapper)):
            folder: str | None = self.training_env.env_method("run_folder", indices=[0])[0]
            if folder is None:  # a search for hyperparameters keeps no runs, and draws γ
                self._discount_as_the_model()
            elif self.save_path is None:
                self.save_path = Path(folder) / NAME
        elif self.save_path is None:
            raise ValueError(
                "ZooDiscoveryCallback needs ZooOptionsWrapper, which tells it the folder of the run: write "
                "`env_wrapper: sb3_options.zoo.ZooOptionsWrapper`."
            )
        super()._on_training_start()
        save_or_warn(self.bank, self.save_path)  # a run that discovers nothing can be played too

    def _discount_as_the_model(self) -> None:
        for venv in (self.training_env, *evaluation_envs(self.locals.get("callback"))):
            if all(venv.env_is_wrapped(ZooOptionsWrapper)):
                venv.env_method("discount_with", self.model.gamma)  # type: ignore[attr-defined]  # every algorithm over discrete actions has it

    def _on_training_end(self) -> None:
        started = not self._ended
        super()._on_training_end()
        if started:
            save_or_warn(self.bank, self.save_path)  # options may have learned further since they were made
