"""`MLflowOutput`: what SB3 logs, in MLflow."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.logger import Figure, HParam, KVWriter, filter_excluded_keys

MOST_OF_PARAMETER = 500
"""Characters of a parameter: what every version of MLflow takes."""


class MLflowOutput(KVWriter):
    """Writes what a model logs to the active MLflow run, beside the other outputs of its logger.

    Numbers are metrics over primitive steps, texts and pictures are artifacts named after tag and step, and the
    settings of TensorBoard's HParams tab are parameters::

        model.set_logger(configure("runs/mlflow", ["tensorboard"]))
        model.logger.output_formats.append(MLflowOutput())

    Raises:
        ModuleNotFoundError: MLflow is not installed.
    """

    takes_pictures = True

    def __init__(self) -> None:
        try:
            import mlflow
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"{error}. MLflow is in an extra: pip install 'sb3-options[tracking]'."
            ) from error
        self._mlflow = mlflow

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write what SB3's logger dumps.

        Args:
            key_values: By tag.
            key_excluded: Outputs that are not to take a tag; this one is named ``mlflow``.
            step: Primitive steps.
        """
        numbers: dict[str, float] = {}
        for key, value in filter_excluded_keys(key_values, key_excluded, "mlflow").items():
            if isinstance(value, HParam):
                parameters = {name: str(each)[:MOST_OF_PARAMETER] for name, each in value.hparam_dict.items()}
                self._mlflow.log_params(parameters)
            elif isinstance(value, Figure):
                self._mlflow.log_figure(value.figure, f"{key}/{step:012}.png")
            elif isinstance(value, str):
                self._mlflow.log_text(value, f"{key}/{step:012}.md")
            elif isinstance(value, int | float | np.number):
                numbers[key] = float(value)
        if numbers:
            self._mlflow.log_metrics(numbers, step=step)
