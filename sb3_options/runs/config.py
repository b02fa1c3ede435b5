"""What a training run is made of: one documented dataclass, from flags, from YAML, and back."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import tyro
import yaml

from sb3_options.runs import algorithms
from sb3_options.runs.algorithms import AlgorithmName
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.creation import OptionLearningSettings

TUNED_FOLDER = Path(__file__).parent / "tuned"

TUNED = {
    f"sb3_options/{name}-v0": "pioneer.yml"
    for name in ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls")
}
"""Defaults that ship with the library, by environment id, ..."""

TUNED_ALGORITHMS = {
    "ppo": "ppo.yml",
    "maskableppo": "ppo.yml",
    "recurrentppo": "ppo.yml",
    "trpo": "ppo.yml",
    "a2c": "a2c.yml",
}
"""... and by algorithm."""


@dataclass(frozen=True)
class TrainConfig:
    """Train an agent that discovers its own options.

    The defaults are tuned for the two-room gridworld; other environments of this library bring their own, which
    `--env ID --help` shows. A second command, `evaluate RUN`, loads a run: see `evaluate --help`. `--config FILE`
    reads any of these settings from YAML; flags win over the file, and the file over the defaults.

    Attributes:
        algo: Algorithm; "optiondqn" is DQN that keeps to the options' initiation sets, as "maskableppo" does too.
        env: Gymnasium environment id, with Discrete actions.
        env_kwargs: Keyword arguments of the environment, as `name:value`; in a file also as a mapping.
        n_timesteps: Length of training, primitive steps over all environments.
        seed: Of everything random.
        tensorboard_log: Folder in which the run folder is made.
        n_envs: Number of parallel environments.
        vec_env: Where they live: "dummy" in this process, "subproc" in one process each.
        eval_freq: Evaluate every so many primitive steps; 0 never does.
        eval_episodes: Episodes of each evaluation.
        progress: Show a progress bar.
        device: Where the network lives: "cpu", "cuda" or "auto".
        num_threads: Threads of torch; a network this small is trained fastest by one.
        options: Start with the options of another run: a file or a run folder.
        max_options: Number of option slots.
        max_new_options: Most options to discover, besides those it starts with; by default one, as in the paper.
        max_runs: MaskablePPO: how often one option may run in an episode; by default any number of times.
        discover: Discover options; without it the slots stay empty.
        gamma: Discount per primitive step.
        learning_rate: Of Adam.
        batch_size: Transitions a gradient step; not for A2C.
        buffer_size: DQN: transitions in the replay buffer.
        learning_starts: DQN: random primitive steps before learning starts.
        train_freq: DQN: decisions between gradient steps.
        target_update_interval: DQN: decisions between updates of the target network.
        exploration_fraction: DQN: share of training over which ε falls.
        exploration_final_eps: DQN: ε after that.
        n_steps: PPO, A2C, TRPO: decisions of each environment in a rollout.
        gae_lambda: PPO, A2C, TRPO: λ of the advantages.
        ent_coef: PPO, A2C: weight of the policy's entropy.
        n_epochs: PPO: passes over a rollout.
        clip_range: PPO: how far the policy may move in an update.
        net_arch: Hidden layers of the network.
        max_option_exploration: DQN: largest share of options among exploratory choices. MaskablePPO: of the
            probability they open with.
        interruption: DQN: end an option where going on is worth less than the best alternative.
        teach_head: DQN: fit the head of a new option to what is stored, at once.
        intra_option: DQN: let every primitive step teach the options that would have taken it.
        close_harmful: Try options in a randomised trial, and close those that do harm.
        discovery: How subgoals are found.
        option: How options are learned.
    """

    algo: AlgorithmName = "dqn"
    env: str = "sb3_options/TwoRooms-v0"
    env_kwargs: tuple[str, ...] = ()
    n_timesteps: int = 60_000
    seed: int = 0
    tensorboard_log: Path = Path("runs")
    n_envs: int = 1
    vec_env: Literal["dummy", "subproc"] = "dummy"
    eval_freq: int = 0
    eval_episodes: int = 10
    progress: bool = True
    device: str = "auto"
    num_threads: int = 1
    options: Path | None = None
    max_options: int = 4
    max_runs: int | None = None
    max_new_options: int | None = 1
    discover: bool = True
    gamma: float = 0.97
    learning_rate: float = 5e-4
    batch_size: int = 64
    buffer_size: int = 50_000
    learning_starts: int = 500
    train_freq: int = 4
    target_update_interval: int = 500
    exploration_fraction: float = 0.5
    exploration_final_eps: float = 0.05
    n_steps: int = 128
    gae_lambda: float = 0.95
    ent_coef: float = 0.01
    n_epochs: int = 10
    clip_range: float = 0.2
    net_arch: tuple[int, ...] = (64, 64)
    max_option_exploration: float = 0.5
    interruption: bool = True
    teach_head: bool = False
    intra_option: bool = False
    close_harmful: bool = False
    discovery: DiscoverySettings = field(default_factory=DiscoverySettings)
    option: OptionLearningSettings = field(default_factory=OptionLearningSettings)

    def __post_init__(self) -> None:
        """Refuse values out of range, by flag."""
        for name in (
            "n_timesteps",
            "n_envs",
            "eval_episodes",
            "buffer_size",
            "batch_size",
            "train_freq",
            "n_steps",
            "n_epochs",
            "num_threads",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}.")
        if self.eval_freq < 0 or self.max_options < 0:
            raise ValueError("--eval-freq and --max-options must be at least 0.")
        if self.max_runs is not None and self.max_runs < 1:
            raise ValueError(f"--max-runs must be at least 1, got {self.max_runs}.")
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"--gamma must be in (0, 1], got {self.gamma}.")
        if not self.learning_rate > 0.0:
            raise ValueError(f"--learning-rate must be positive, got {self.learning_rate}.")
        if not 0.0 < self.exploration_fraction <= 1.0:
            raise ValueError(f"--exploration-fraction must be in (0, 1], got {self.exploration_fraction}.")
        for name in ("exploration_final_eps", "gae_lambda", "max_option_exploration"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"--{name.replace('_', '-')} must be in [0, 1], got {getattr(self, name)}.")
        if not self.clip_range > 0.0:
            raise ValueError(f"--clip-range must be positive, got {self.clip_range}.")
        if not 0.0 <= self.ent_coef < math.inf:
            raise ValueError(f"--ent-coef must be at least 0, got {self.ent_coef}.")
        if self.close_harmful and self.discovery.segmentation == "peaks":
            raise ValueError("--close-harmful compares episodes, and a continuing task has none: leave it out.")
        if self.max_runs is not None and self.discovery.segmentation == "peaks":
            raise ValueError("--max-runs counts in an episode, and a continuing task has none: leave it out.")
        if any(":" not in pair for pair in self.env_kwargs):
            raise ValueError(f"--env-kwargs takes pairs name:value, got {' '.join(self.env_kwargs)}.")

        self._check_settings_of_the_algorithm()

    def _check_settings_of_the_algorithm(self) -> None:
        known = algorithms.known_to(self.algo)
        if known >= {"n_steps", "batch_size"} and (self.n_steps * self.n_envs < 2 or self.batch_size < 2):
            raise ValueError(
                f"{self.algo} normalises advantages, which takes two: --n-steps times --n-envs and --batch-size must "
                f"be at least 2, got {self.n_steps} times {self.n_envs} and {self.batch_size}."
            )
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        # A setting that the algorithm does not know must be left at its default.
        for name in sorted(algorithms.EVERY_SETTING - known):
            if getattr(self, name) != defaults[name]:
                raise ValueError(
                    f"--{name.replace('_', '-')} has no effect on {self.algo}: it is a setting of "
                    f"{', '.join(algorithms.knowing(name))}. Leave it out."
                )

    def env_keywords(self) -> dict[str, Any]:
        """``env_kwargs`` as keyword arguments; values are read as YAML, so that 3 is a number.

        Raises:
            ValueError: A value is no YAML that can be read safely.
        """
        keywords: dict[str, Any] = {}
        for name, _, value in (pair.partition(":") for pair in self.env_kwargs):
            try:
                keywords[name] = yaml.safe_load(value)
            except yaml.YAMLError as error:
                raise ValueError(
                    f"--env-kwargs: the value of {name!r} is no YAML that can be read safely: {error}"
                ) from error
        return keywords


def parse(args: Sequence[str], prog: str = "train.py") -> TrainConfig:
    """Flags → configuration. Exits with a message where they make no sense.

    Args:
        args: Without the program's name.
        prog: For the help text.

    Returns:
        The resolved configuration.
    """
    config_file, rest = _split_config_flag(args)
    try:
        from_file = {} if config_file is None else read_yaml(config_file)
        env, algo = (
            _last(flag, rest) or str(from_file.get(flag, getattr(TrainConfig, flag))) for flag in ("env", "algo")
        )
        default = tuned(env, algo)
        return tyro.cli(TrainConfig, prog=prog, default=default, args=[*_flags(from_file), *rest])
    except (ValueError, OSError) as error:
        sys.exit(f"{prog}: {error}")


def tuned(env_id: str, algo: str = TrainConfig.algo) -> TrainConfig:
    """The defaults for an environment and an algorithm: those that ship for them, or else those of `TrainConfig`.

    Those of an environment win. They were chosen with DQN; an on-policy algorithm takes over what is not about
    learning.
    """
    settings: dict[str, Any] = {}
    if algo in TUNED_ALGORITHMS:
        settings |= {**read_yaml(TUNED_FOLDER / TUNED_ALGORITHMS[algo]), "algo": algo}
    if env_id in TUNED:
        of_env = read_yaml(TUNED_FOLDER / TUNED[env_id])
        keep = algo not in algorithms.ON_POLICY
        settings |= {k: v for k, v in of_env.items() if keep or k not in algorithms.EVERY_SETTING | {"learning_rate"}}
    return tyro.cli(TrainConfig, args=list(_flags(settings)))


def load(path: Path) -> TrainConfig:
    """The configuration that `save` wrote.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no mapping of settings.
    """
    return tyro.cli(TrainConfig, args=list(_flags(read_yaml(path))))


def save(config: TrainConfig, path: Path) -> None:
    """Write a configuration as YAML that `--config` reads back."""
    path.write_text(yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False), encoding="utf-8")


def read_yaml(path: Path) -> Mapping[str, Any]:
    """A YAML file with a mapping at its top, read without running anything in it.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no YAML, or no mapping.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML that can be read safely: {error}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold `name: value` lines, got a {type(content).__name__}.")
    return content


def _last(name: str, args: Sequence[str]) -> str | None:
    """The value of the last flag of this name."""
    found = None
    for arg, following in pairwise([*args, ""]):
        if arg == f"--{name}":
            found = following
        elif arg.startswith(f"--{name}="):
            found = arg.partition("=")[2]
    return found


def _split_config_flag(args: Sequence[str]) -> tuple[Path | None, list[str]]:
    rest, config_file = list(args), None
    for i, arg in enumerate(args):
        if arg == "--config":
            if i + 1 == len(args):
                sys.exit("--config needs a file.")
            config_file, rest = args[i + 1], [*args[:i], *args[i + 2 :]]
        elif arg.startswith("--config="):
            config_file, rest = arg.partition("=")[2], [*args[:i], *args[i + 1 :]]
    return (None if config_file is None else Path(config_file)), rest


def _flags(settings: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """A mapping as the flags that say the same, so that a file is checked just as flags are."""
    for name, value in settings.items():
        flag = f"{prefix}{str(name).replace('_', '-')}"
        if flag == "env-kwargs" and isinstance(value, Mapping):
            # JSON is YAML on one line, as a flag has it.
            yield from (f"--{flag}", *(f"{key}:{json.dumps(v)}" for key, v in value.items()))
        elif isinstance(value, Mapping):
            yield from _flags(value, f"{flag}.")
        elif isinstance(value, bool):
            head, _, last = flag.rpartition(".")
            yield f"--{head}{'.' if head else ''}{'' if value else 'no-'}{last}"
        elif isinstance(value, list | tuple):
            yield from (f"--{flag}", *map(str, value))
        else:
            yield from (f"--{flag}", str(value))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value
