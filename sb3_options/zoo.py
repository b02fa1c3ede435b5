"""A wrapper for the YAML files of rl-zoo3, which finds the options of the run that is played.

rl-zoo3 trains, plays (``rl_zoo3.enjoy``) and records (``rl_zoo3.record_video``) in separate processes, and passes to
its wrappers only the arguments in the YAML file. A model that has learned to choose options needs them in the
environment it is played in. So `ZooOptionsWrapper` reads from the command line which run that is.
"""

import argparse
import multiprocessing
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.option_run import OptionRun

FILES = Path(__file__).with_name("rl_zoo3")  # of YAML files, one per algorithm: ``python -m sb3_options.zoo`` prints it
PLAYERS = ("enjoy", "record_video", "push_to_hub")  #: Programs of rl-zoo3 that load a run.


class ZooOptionsWrapper(OptionsWrapper):
    """`OptionsWrapper` that starts with the options of the run that rl-zoo3 loads.

    In `PLAYERS` these are the options of the run that is played; in ``rl_zoo3.train --trained-agent FILE`` those of
    that model; else there are none at first. The model's zip holds them.

    Args:
        env: Its action space must be ``Discrete`` and start at 0.
        max_options: Number of slots.
        options_file: Another file to start with.
        **kwargs: Arguments of `OptionsWrapper`.

    Raises:
        FileNotFoundError: The run has no model.
        ValueError: The model holds no options, they do not fit, or the running program is unknown.
    """

    def __init__(self, env: gym.Env[Any, Any], max_options: int = 4, **kwargs: Any) -> None:
        if kwargs.get("options_file") is None:
            kwargs["options_file"] = loaded_model(_program(), sys.argv[1:])
        super().__init__(env, max_options, **kwargs)

    def discount_with(self, gamma: float) -> None:
        """Adopt the discount of the algorithm."""
        self.gamma = float(gamma)
        self._primitive = OptionRun(-1, 1, self.gamma, self.gamma, "primitive").as_info()


def loaded_model(program: str, arguments: Sequence[str]) -> Path | None:
    """Return the model file that a program of rl-zoo3 loads, such as ``enjoy``; None if it loads none.

    Flags may be abbreviated, as in rl-zoo3, which has already refused ambiguous ones.
    """
    parser = argparse.ArgumentParser(add_help=False)
    if program == "train":
        parser.add_argument("-i", "--trained-agent", default="")
        agent = parser.parse_known_args(arguments)[0].trained_agent
        return Path(agent) if agent else None
    if program not in PLAYERS:
        return None
    # Imported here: the wrapper is useful without rl-zoo3 as well.
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import get_latest_run_id, get_model_path

    # The names and defaults are rl-zoo3's own.
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("-f", "--folder", default="rl-trained-agents")
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--exp-id", default=0, type=int)
    parser.add_argument("--load-best", action="store_true")
    parser.add_argument("--load-checkpoint")
    parser.add_argument("--load-last-checkpoint", action="store_true")
    known = parser.parse_known_args(arguments)[0]
    name = EnvironmentName(known.env)
    runs: Path = Path(known.folder) / known.algo
    run = known.exp_id or get_latest_run_id(str(runs), name)
    which = known.load_best, known.load_checkpoint, known.load_last_checkpoint
    try:
        return Path(get_model_path(run or -1, known.folder, known.algo, name, *which)[1])
    except (AssertionError, ValueError):  # there is no model; rl-zoo3 says so itself
        return (runs / f"{name}_{run}" if run > 0 else runs) / f"{name}.zip"


def _program() -> str:
    """Return the name of the running program."""
    name = Path(sys.argv[0]).stem
    if name != "rl_zoo3":
        return name
    # The command drops its subcommand from sys.argv, and a worker process gets only sys.argv.
    if multiprocessing.parent_process() is not None:
        raise ValueError(
            "In a worker process ZooOptionsWrapper cannot tell which program runs: start `python -m rl_zoo3.train` or "
            "`python -m rl_zoo3.enjoy` instead of `rl_zoo3 train` or `rl_zoo3 enjoy`."
        )
    return sys.orig_argv[sys.orig_argv.index(sys.argv[0]) + 1]


if __name__ == "__main__":
    print(FILES)
