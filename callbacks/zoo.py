"""`SubgoalDiscoveryCallback` for rl-zoo3."""

from __future__ import annotations

from pathlib import Path

from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback
from sb3_options.callbacks.summaries import save_or_warn
from sb3_options.options.archive import NAME
from sb3_options.zoo import ZooOptionsWrapper


class ZooDiscoveryCallback(SubgoalDiscoveryCallback):
    """Discovers options, and keeps them in the folder of the run that rl-zoo3 trains, beside the model.

    There `ZooOptionsWrapper` finds them when the run is played. Everything else is `SubgoalDiscoveryCallback`, whose
    arguments it takes; ``save_path`` is another place for the file.

    Raises:
        ValueError: When training starts, if the environment is not wrapped in `ZooOptionsWrapper`.
    """

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.save_path is None:
            if not all(self.training_env.env_is_wrapped(ZooOptionsWrapper)):
                raise ValueError(
                    "ZooDiscoveryCallback needs ZooOptionsWrapper, which tells it the folder of the run: write "
                    "`env_wrapper: sb3_options.zoo.ZooOptionsWrapper`."
                )
            folder: str | None = self.training_env.env_method("run_folder", indices=[0])[0]
            # A search for hyperparameters keeps no runs.
            self.save_path = None if folder is None else Path(folder) / NAME
        save_or_warn(self.bank, self.save_path)  # a run that discovers nothing can be played too

    def _on_training_end(self) -> None:
        super()._on_training_end()
        save_or_warn(self.bank, self.save_path)  # options may have learned further since they were made
