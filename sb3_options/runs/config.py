"""What a training run is made of: a class of settings for every family of algorithms, over what they share."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_args, get_type_hints

import tyro
from pydantic import AfterValidator, BeforeValidator, TypeAdapter, ValidationError

from sb3_options.atomic import atomic_write
from sb3_options.checked import Field, readable, settings, truth_values
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.runs import yaml_file
from sb3_options.runs.keywords import PAIRS, algo_keywords_of, keywords_of, rule_of
from sb3_options.runs.shipped import shipped
from sb3_options.runs.users_code import with_trusted

DEFAULT_ALGO = "maskableppo"
"""What ``train.py`` demonstrates: its options run in their initiation sets only, and lead where they are meant to."""

MAX_SEED = 2**32 - 1
"""NumPy's generators, which SB3 seeds, take no larger one."""

MAX_THREADS = 1024
"""More than any machine has cores for; torch would take memory for each."""

NAME, KIND = tyro.conf.arg(metavar="NAME"), tyro.conf.arg(metavar="KIND")  # of something in a module; of a choice
NUMBER, REAL = (tyro.conf.arg(metavar=name) for name in "NX")  # short, so that the help fits a line
Count: TypeAlias = Annotated[int, Field(ge=1)]
Natural: TypeAlias = Annotated[int, Field(ge=0)]
Share: TypeAlias = Annotated[float, Field(ge=0.0, le=1.0)]
Positive: TypeAlias = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


@settings
class TrainConfig:
    """Train an agent that discovers its own options.

    Attributes:
        algo: Name of the algorithm.
        env: Gymnasium id.
        env_kwargs: Keyword arguments of the environment.
        env_wrapper: Wrapper for it, module:Class.
        feature_map: φ: module:function, or one to learn.
        n_timesteps: Primitive steps of all environments.
        seed: Of everything random.
        tensorboard_log: Folder for run folders.
        n_envs: Parallel environments.
        vec_env: "dummy", "subproc" or "ray".
        eval_freq: Primitive steps per evaluation; 0: none.
        checkpoint_freq: Steps per checkpoint; 0: none.
        eval_episodes: Episodes of an evaluation.
        eval_max_steps: Longest, in primitive steps; 0: any.
        progress: Show a progress bar.
        device: "cpu", "cuda" or "auto".
        num_threads: Threads of torch; small networks want 1.
        options: Run, model or options to start with.
        max_options: Number of option slots.
        max_new_options: Most to discover; None fills the slots.
        discover: If not, empty slots stay empty.
        compare: Also train without, and compare.
        gamma: Discount γ per primitive step.
        learning_rate: Step size of the optimiser.
        net_arch: Hidden layers of the network.
        algo_kwargs: Keyword arguments of SB3's class besides.
        bonus: "counts" or "rnd": an intrinsic reward.
        success: terminated, return:30, steps:500.
        discovery: How subgoals are found.
        option: How options are learned.
        usefulness: How options are judged by their use.
    """

    algo: Annotated[str, tyro.conf.Suppress]
    env: str = "sb3_options/TwoRooms-v0"
    env_kwargs: Annotated[dict[str, Any], BeforeValidator(keywords_of), PAIRS] = field(default_factory=dict)
    env_wrapper: Annotated[str | None, NAME] = None
    feature_map: Annotated[str | None, NAME] = None
    n_timesteps: Count = 60_000
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)] = 0
    tensorboard_log: Path = Path("runs")
    n_envs: Count = 1
    vec_env: Annotated[Literal["dummy", "subproc", "ray"], KIND] = "dummy"
    eval_freq: Natural = 0
    checkpoint_freq: Annotated[Natural, NUMBER] = 10_000
    eval_episodes: Annotated[Count, NUMBER] = 10
    eval_max_steps: Annotated[Natural, NUMBER] = 1_000
    progress: bool = True
    device: str = "auto"
    num_threads: Annotated[int, Field(ge=1, le=MAX_THREADS)] = 1
    options: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    max_options: Natural = 4
    max_new_options: Natural | None = 1
    discover: bool = True
    compare: bool = False
    gamma: Annotated[float, Field(gt=0.0, le=1.0)] = 0.97
    learning_rate: Annotated[Positive, REAL] = 5e-4
    net_arch: Annotated[tuple[Count, ...], tyro.conf.arg(metavar="N ...")] = (64, 64)
    algo_kwargs: Annotated[dict[str, Any], BeforeValidator(algo_keywords_of), PAIRS] = field(default_factory=dict)
    bonus: Annotated[Literal["none", "counts", "rnd"], KIND] = "none"
    success: Annotated[str, AfterValidator(rule_of), tyro.conf.arg(metavar="RULE")] = "reported"
    discovery: DiscoverySettings = field(default_factory=DiscoverySettings)
    option: OptionLearningSettings = field(default_factory=OptionLearningSettings)
    usefulness: UsefulnessSettings = field(default_factory=UsefulnessSettings)


@settings
class DQNConfig(TrainConfig):
    """Train an agent that discovers its own options with DQN, QRDQN or OptionDQN.

    OptionDQN is DQN that keeps to the initiation sets of options. The defaults are tuned for the two-room gridworld.

    Attributes:
        batch_size: Transitions of a gradient step.
        buffer_size: Transitions in the replay buffer.
        learning_starts: Random primitive steps first.
        train_freq: Decisions between gradient steps.
        target_update_interval: Decisions between target updates.
        exploration_fraction: Share of training over which ε falls.
        exploration_final_eps: ε after that.
        max_option_exploration: Largest share of options in exploring.
        n_steps: Decisions of a return.
        interruption: End options worth less than others.
    """

    algo: Annotated[Literal["dqn", "qrdqn", "optiondqn"], tyro.conf.Suppress] = "dqn"
    batch_size: Count = 64
    buffer_size: Count = 50_000
    learning_starts: Annotated[Natural, NUMBER] = 500
    train_freq: Count = 4
    target_update_interval: Count = 500
    exploration_fraction: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    exploration_final_eps: Share = 0.05
    max_option_exploration: Share = 0.5
    n_steps: Count = 1
    interruption: bool = True


@settings
class OnPolicyConfig(TrainConfig):
    """What A2C, TRPO and PPO share. The defaults are tuned for gridworlds.

    Attributes:
        n_steps: Decisions per environment and rollout.
        gae_lambda: λ of the advantages.
    """

    n_envs: Count = 8
    learning_rate: Annotated[Positive, REAL] = 1e-3
    n_steps: Count = 128
    gae_lambda: Share = 0.95


@settings
class A2CConfig(OnPolicyConfig):
    """Train an agent that discovers its own options with A2C.

    Attributes:
        ent_coef: Weight of the policy's entropy.
    """

    algo: Annotated[Literal["a2c"], tyro.conf.Suppress] = "a2c"
    n_steps: Count = 16
    ent_coef: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.01


@settings
class TRPOConfig(OnPolicyConfig):
    """Train an agent that discovers its own options with TRPO.

    Attributes:
        batch_size: Transitions of a gradient step.
    """

    algo: Annotated[Literal["trpo"], tyro.conf.Suppress] = "trpo"
    batch_size: Count = 256

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        if self.n_steps * self.n_envs < 2 or self.batch_size < 2:
            raise ValueError(
                f"{self.algo} normalises advantages, which takes two: --n-steps times --n-envs and --batch-size must "
                f"be at least 2, got {self.n_steps} times {self.n_envs} and {self.batch_size}."
            )


@settings
class PPOConfig(TRPOConfig):
    """Train an agent that discovers its own options with PPO or RecurrentPPO.

    Attributes:
        n_epochs: Passes over a rollout.
        ent_coef: Weight of the policy's entropy.
        clip_range: How far the policy may move in an update.
    """

    algo: Annotated[Literal["ppo", "recurrentppo"], tyro.conf.Suppress] = "ppo"  # type: ignore[assignment]  # it inherits settings, not the name
    n_epochs: Count = 10
    ent_coef: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.01
    clip_range: Positive = 0.2


@settings
class MaskablePPOConfig(PPOConfig):
    """Train an agent that discovers its own options with MaskablePPO, which keeps to their initiation sets.

    Attributes:
        max_option_exploration: Probability a first option opens with.
        max_runs: Of an option in an episode.
    """

    algo: Annotated[Literal["maskableppo"], tyro.conf.Suppress] = "maskableppo"  # type: ignore[assignment]  # likewise
    max_option_exploration: Share = 0.5
    max_runs: Annotated[Count | None, NUMBER] = None

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        super().__post_init__()
        if self.max_runs is not None and self.discovery.segmentation == "peaks":
            raise ValueError("--max-runs counts in an episode, and a continuing task has none: leave it out.")


HOW_IT_RAN = frozenset(
    {"checkpoint_freq", "compare", "device", "num_threads", "progress", "tensorboard_log", "vec_env"}
)
"""Settings that say nothing of what is learned."""

COMMANDS = ("train", "evaluate", "resume", "compare", "tune", "options")
"""The other first words of a command line."""

CLASSES: dict[str, type[TrainConfig]] = {
    algo: of
    for of in (DQNConfig, PPOConfig, A2CConfig, TRPOConfig, MaskablePPOConfig)
    for algo in get_args(get_type_hints(of)["algo"])
}
"""The class of settings of every algorithm."""

GROUPS = {"discovery": DiscoverySettings, "option": OptionLearningSettings, "usefulness": UsefulnessSettings}
"""The settings that are classes of settings themselves."""

COMMON = frozenset(f.name for f in dataclasses.fields(TrainConfig))
"""The settings that every algorithm has."""

OF_ALL = frozenset().union(*({f.name for f in dataclasses.fields(of)} for of in CLASSES.values()))
"""The settings of all algorithms."""

FOR_ANOTHER = COMMON - {"n_envs", "learning_rate", "algo_kwargs"}
"""What a file says of another algorithm than its own."""


def load(path: Path, trusted: Mapping[str, str | None] | None = None) -> TrainConfig:
    """The configuration that `save` wrote.

    Args:
        path: Of the file.
        trusted: What the user has named on the command line, as `read` takes it.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no configuration, or names what would import a module.
    """
    return made(read(path, trusted), path)


def save(config: TrainConfig, path: Path) -> None:
    """Write a configuration as YAML that ``--config`` reads back."""
    content = TypeAdapter(type(config)).dump_python(config, mode="json")
    with atomic_write(path) as temporary:
        temporary.write_text(yaml_file.dump(content, sort_keys=False), encoding="utf-8")


def read(path: Path, trusted: Mapping[str, str | None] | None = None) -> dict[str, Any]:
    """The settings in a file, not checked yet.

    Args:
        path: Of the file.
        trusted: ``env``, ``env_wrapper`` and ``feature_map``, which take the place of the file's own; None leaves it.

    Raises:
        OSError: The file cannot be read.
        ValueError: It holds no settings, or names what would import a module.
    """
    values = yaml_file.read_mapping(path)
    values = {str(name).replace("-", "_"): value for name, value in values.items()}
    return with_trusted(values, trusted or {}, path)


def default_algo(env_id: str) -> str:
    """The algorithm of a command line that names none."""
    return str(shipped(env_id).get("algo", DEFAULT_ALGO))


def tuned(env_id: str, algo: str = "dqn") -> TrainConfig:
    """The defaults for an environment and an algorithm."""
    return made({"env": env_id, "algo": algo}, env_id)


def made(values: Mapping[str, Any], where: str | Path) -> TrainConfig:
    """The configuration with these settings; the others have the defaults of environment and algorithm.

    Values without an ``algo`` are for the default algorithm of the environment.

    Args:
        values: By name; a file may spell names as flags.
        where: The values come from, for errors.

    Raises:
        ValueError: A setting is not known, has no effect, or is out of its range.
    """
    values = with_method(values, where)
    env_id = str(values.get("env", TrainConfig.env))
    algo = str(values.get("algo", default_algo(env_id)))
    known = {"": names_of(algo)} | {f"{name}.": [f.name for f in dataclasses.fields(of)] for name, of in GROUPS.items()}

    everywhere = {name: group + name for group, names in reversed(known.items()) for name in names}

    def kept(values: Mapping[str, Any], group: str = "") -> dict[str, Any]:
        those: dict[str, Any] = {}
        for spelt, value in values.items():
            name = str(spelt).replace("-", "_")
            of, _, inner = name.partition(".")
            if name in known[group] and name in GROUPS and isinstance(value, Mapping):
                those[name] = {**those.get(name, {}), **kept(value, f"{name}.")}
            elif name in known[group]:
                those[name] = value
            elif not group and inner and of in GROUPS:  # discovery.min_positive: 8
                part = those.setdefault(of, {})
                those[of] = {**part, **kept({inner: value}, f"{of}.")} if isinstance(part, dict) else part
            elif not group and name in OF_ALL:
                raise ValueError(f"{where}: {no_effect(name, algo)}")
            else:
                near = difflib.get_close_matches(name, known[group] if group else everywhere, n=1, cutoff=0.0)[0]
                near = group + near if group else everywhere[near]
                raise ValueError(f"{where}: there is no setting {group + name!r}. Did you mean {near!r}?")
        return those

    content = {name: value for name, value in shipped(env_id).items() if name in known[""]} | {"algo": algo}
    for name, value in kept(values).items():
        content[name] = {**content.get(name, {}), **value} if name in GROUPS and isinstance(value, dict) else value
    try:
        config: TrainConfig = TypeAdapter(CLASSES[algo]).validate_python(content)
    except ValidationError as error:
        raise ValueError(f"{where}: {readable(error)}") from None
    if wrong := truth_values(content, config):
        raise ValueError(f"{where}: {wrong}.")
    return config


def with_method(values: Mapping[str, Any], where: str | Path) -> Mapping[str, Any]:
    """Values in which ``method``, if there is one, is a setting of discovery: ``--method`` for short."""
    if "method" not in values:
        return values
    discovery = values.get("discovery", {})
    if not isinstance(discovery, Mapping) or "method" in discovery:
        raise ValueError(f"{where}: method is short for discovery.method: give one of them.")
    rest = {name: value for name, value in values.items() if name != "method"}
    return {**rest, "discovery": {**discovery, "method": values["method"]}}


def names_of(algo: str) -> list[str]:
    """The settings of an algorithm.

    Raises:
        ValueError: There is no such algorithm.
    """
    if algo not in CLASSES:
        near = difflib.get_close_matches(algo, [*CLASSES, *COMMANDS], n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"There is no algorithm {algo!r}: choose from {', '.join(CLASSES)}.{hint}")
    return [f.name for f in dataclasses.fields(CLASSES[algo])]


def no_effect(name: str, algo: str) -> str:
    """What to say of a setting that an algorithm does not have."""
    having = ", ".join(other for other in CLASSES if name in names_of(other))
    return f"--{name.replace('_', '-')} has no effect on {algo}: it is a setting of {having}. Leave it out."
