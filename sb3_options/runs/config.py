"""The settings of a training run: one class, its defaults, and files of settings.

Nothing here imports torch or Stable-Baselines3, so the help is shown at once. `algorithms` checks what belongs to
SB3's classes.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import sys
from collections.abc import Mapping
from dataclasses import field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, TypeAdapter

from sb3_options.atomic import atomic_write
from sb3_options.checked import Field, settings
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.embedding.settings import LEARNED
from sb3_options.experience.success import success_rule
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.runs import yaml_file

ALGORITHMS = {
    "maskableppo": ("sb3_contrib", "MaskablePPO"),
    "ppo": ("stable_baselines3", "PPO"),
    "a2c": ("stable_baselines3", "A2C"),
    "trpo": ("sb3_contrib", "TRPO"),
    "recurrentppo": ("sb3_contrib", "RecurrentPPO"),
    "dqn": ("stable_baselines3", "DQN"),
    "qrdqn": ("sb3_contrib", "QRDQN"),
    "optiondqn": ("sb3_options.learning.dqn", "OptionDQN"),
}
"""Module and class of each algorithm. The first is the default: its options run in their initiation sets only."""

OFF_POLICY = ("dqn", "qrdqn", "optiondqn")

COMMANDS = ("train", "demo", "evaluate", "resume", "compare", "tune", "options")
"""The other first words of a command line."""

MAX_SEED = 2**32 - 1
"""NumPy's generators, which SB3 seeds, take no larger one."""

MAX_ENVS = 10_000
MAX_OPTIONS = 10_000
"""More than any run has. A larger number in a stranger's file would only use up memory."""

IMPORTING = {"env": "environment", "env_wrapper": "wrapper", "feature_map": "feature map"}
"""Settings that may import a module, and what each is: only the command line is trusted with them."""

Natural: TypeAlias = Annotated[int, Field(ge=0)]
Count: TypeAlias = Annotated[int, Field(ge=1)]


def keywords_of(pairs: Any) -> Any:
    """Pairs ``name:value`` as keyword arguments; a value is read as YAML, so that 3 is a number."""
    if not isinstance(pairs, str | list | tuple):
        return pairs  # a mapping, or what pydantic refuses
    keywords = {}
    for pair in [pairs] if isinstance(pairs, str) else pairs:
        name, colon, value = str(pair).partition(":")
        if not colon:
            raise ValueError(f"keyword arguments are pairs name:value, got {pair}.")
        keywords[name] = value_of(value)
    return keywords


def value_of(text: str) -> Any:
    """A value of the command line, read as YAML; None is None."""
    return None if text == "None" else yaml_file.parse(text)


Keywords: TypeAlias = Annotated[dict[str, Any], BeforeValidator(keywords_of)]


def _named_rule(text: str) -> str:
    """The text of ``--success``, which must name a rule."""
    success_rule(text)
    return text


@settings
class TrainConfig:
    """Train an agent that discovers its own options.

    Attributes:
        algo: Name of the algorithm.
        env: Gymnasium id.
        env_kwargs: Keyword arguments of the environment.
        n_timesteps: Primitive steps of all environments.
        seed: Random seed.
        n_envs: Parallel environments.
        options: Run, model or options to start with.
        max_options: Number of option slots.
        max_new_options: Most to discover; None fills the slots.
        discover: If not, empty slots stay empty.
        compare: Train once more without discovery, and compare.
        eval_freq: Primitive steps per evaluation; 0: none.
        tensorboard_log: Folder for run folders.
        gamma: Discount γ per primitive step.
        algo_kwargs: Arguments of SB3's class; or as flags: --n-steps 64.
        env_wrapper: Wrapper of the environment, module:Class.
        feature_map: φ: module:function, or temporal-distance.
        bonus: Intrinsic reward: none, counts or rnd.
        success: terminated, return:30, steps:500.
        checkpoint_freq: Primitive steps per checkpoint; 0: none.
        eval_episodes: Episodes of an evaluation.
        eval_max_steps: Longest of them, in primitive steps; 0: any.
        vec_env: Where environments run: dummy, subproc or ray.
        device: cpu, cuda or auto.
        progress: Show a progress bar.
        discovery: How subgoals are found.
        option: How options are learned.
        usefulness: How options are judged by their use.
    """

    algo: str = "maskableppo"
    env: str = "sb3_options/TwoRooms-v0"
    env_kwargs: Keywords = field(default_factory=dict)
    n_timesteps: Count = 60_000
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)] = 0
    n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 8
    options: Path | None = None
    max_options: Annotated[int, Field(ge=0, le=MAX_OPTIONS)] = 4
    max_new_options: Natural | None = 1
    discover: bool = True
    compare: bool = False
    eval_freq: Natural = 0
    tensorboard_log: Path = Path("runs")
    gamma: Annotated[float, Field(gt=0.0, le=1.0)] = 0.97
    algo_kwargs: Keywords = field(default_factory=dict)
    env_wrapper: str | None = None
    feature_map: str | None = None
    bonus: Literal["none", "counts", "rnd"] = "none"
    success: Annotated[str, AfterValidator(_named_rule)] = "reported"
    checkpoint_freq: Natural = 10_000
    eval_episodes: Count = 10
    eval_max_steps: Natural = 1_000
    vec_env: Literal["dummy", "subproc", "ray"] = "dummy"
    device: Annotated[str, Field(pattern="^(auto|cpu|mps|cuda(:[0-9]+)?)$")] = "auto"
    progress: bool = True
    discovery: DiscoverySettings = field(default_factory=DiscoverySettings)
    option: OptionLearningSettings = field(default_factory=OptionLearningSettings)
    usefulness: UsefulnessSettings = field(default_factory=UsefulnessSettings)


FIELDS = {f.name: f for f in dataclasses.fields(TrainConfig)}
GROUPS = {"discovery": DiscoverySettings, "option": OptionLearningSettings, "usefulness": UsefulnessSettings}
"""The settings that are classes of settings themselves."""

SPELT = {
    'IntrinsicRewardCallback("rnd")': "--bonus rnd",
    "gym.make(..., max_episode_steps=500)": "--env-kwargs max_episode_steps:500",
}
"""What a script does with calls, as flags."""

HOW_IT_RAN = frozenset({"checkpoint_freq", "compare", "device", "progress", "tensorboard_log", "vec_env"})
"""Settings without effect on learning."""

CONFIG = "config.yml"
"""File of the settings in a run folder."""

OWN = ("algo", "algo_kwargs", "n_envs")
"""What a file says of its own algorithm only."""

PIONEERS = ("Pioneer", "PioneerCorner", "PioneerClutter", "PioneerTwoBalls", "PioneerMuJoCo")
"""Environments of the robot, which share a file of settings."""


def configure(**values: Any) -> TrainConfig:
    """The configuration with these settings; the others have the defaults of environment and algorithm."""
    return build(values, "settings")


def build(values: Mapping[str, Any], source: str | Path) -> TrainConfig:
    """As `configure` does; an error begins with ``source``, and names may have hyphens, or dots before a group's."""
    try:
        of_env = _tuned(str(values.get("env", TrainConfig.env)))
        algo = str(values.get("algo", of_env.get("algo", TrainConfig.algo)))
        check_algo(algo)
        blocks = [block for names, block in shipped("defaults.yml").items() if algo in names.split()]
        of_algo = {name: value for block in blocks for name, value in block.items()}
        of_env = {name: value for name, value in of_env.items() if name in (*FIELDS, *of_algo)}
        content, arguments = _sorted(of_algo | of_env)
        given, own = _sorted(values)
        if own:
            from sb3_options.runs.algorithms import checked_arguments  # which imports SB3

            own = checked_arguments(algo, own)
        for group in GROUPS.keys() & content.keys() & given.keys():
            if isinstance(given[group], Mapping):
                given[group] = content[group] | given[group]
        return TrainConfig(**content | given | {"algo": algo, "algo_kwargs": _with_layers(arguments, own)})
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def _sorted(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings by the names of `TrainConfig`, and apart from them arguments of the algorithm's class."""
    fields: dict[str, Any] = {}
    own: dict[str, Any] = {}
    for spelling, value in values.items():
        name = str(spelling).replace("-", "_")
        name = "discovery.method" if name == "method" else name
        group, _, inner = name.partition(".")
        if name == "algo_kwargs":
            value = keywords_of(value)
            own |= value if isinstance(value, Mapping) else {name: value}
        elif group in GROUPS and (inner or isinstance(value, Mapping)):
            part = {inner: value} if inner else {str(key).replace("-", "_"): each for key, each in value.items()}
            for key in part.keys() - GROUPS[group].__annotations__.keys():
                raise ValueError(unknown(f"{group}.{key}"))
            before = fields.get(group, {})
            fields[group] = {**before, **part} if isinstance(before, Mapping) else before
        else:
            (fields if name in FIELDS else own)[name] = value
    return fields, own


def _with_layers(before: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the algorithm, later ones in the place of earlier ones; ``net_arch`` is one of policy_kwargs."""
    both = {**before, **later}
    policy: dict[str, Any] = {}
    for each in (before, later):
        policy |= each.get("policy_kwargs") or {}
        policy |= {"net_arch": list(each["net_arch"])} if "net_arch" in each else {}
    both.pop("net_arch", None)
    return both | ({"policy_kwargs": policy} if policy else {})


def _tuned(env_id: str) -> dict[str, Any]:
    """The settings that ship for an environment."""
    if env_id.removeprefix("minigrid:").startswith(("MiniGrid-", "BabyAI-")):  # MiniGrid's own test is slow to import
        return shipped("tuned/minigrid.yml")
    of_robot = env_id.removeprefix("sb3_options/").removesuffix("-v0") in PIONEERS
    return shipped("tuned/pioneer.yml") if of_robot else {}


@cache
def shipped(file: str) -> dict[str, Any]:
    """A file of settings that comes with the library."""
    return yaml_file.read_mapping(Path(__file__).parent / file)


def check_algo(algo: str) -> None:
    """Refuse the name of no algorithm."""
    if algo not in ALGORITHMS:
        near = difflib.get_close_matches(algo, [*ALGORITHMS, *COMMANDS], n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"There is no algorithm {algo!r}: choose from {', '.join(ALGORITHMS)}.{hint}")


def unknown(name: str, arguments: Mapping[str, Any] | None = None) -> str:
    """What to say of an unknown setting, with the nearest one."""
    known = {name: name for name in (*FIELDS, *(arguments or {}))}
    for group, of in GROUPS.items():
        known = {f.name: f"{group}.{f.name}" for f in dataclasses.fields(of)} | known
    near = difflib.get_close_matches(name.rpartition(".")[2], known, n=1)
    hint = f" Did you mean {known[near[0]]!r}?" if near else ""
    return f"there is no setting {name!r}.{hint}"


def load(path: Path, trusted: Mapping[str, str | None] | None = None) -> TrainConfig:
    """The configuration that `save` wrote."""
    return build(read(path, trusted), path)


def save(config: TrainConfig, path: Path) -> None:
    """Write a configuration as YAML that ``--config`` reads back."""
    with atomic_write(path) as temporary:
        temporary.write_text(yaml_file.dump(as_values(config), sort_keys=False), encoding="utf-8")


def as_values(config: TrainConfig) -> dict[str, Any]:
    """All settings by name, as JSON has values."""
    values: dict[str, Any] = TypeAdapter(TrainConfig).dump_python(config, mode="json")
    return values


def read(path: Path, trusted: Mapping[str, str | None] | None = None) -> dict[str, Any]:
    """The settings in a file, not checked yet; ``trusted`` are those of `IMPORTING` that the command line names."""
    values = {str(name).replace("-", "_"): value for name, value in yaml_file.read_mapping(path).items()}
    return with_trusted(values, trusted or {}, path)


def importing(values: Mapping[str, Any]) -> dict[str, str]:
    """Those of the settings ``values`` that would import a module, by name."""
    texts = {name: str(values.get(name) or "") for name in IMPORTING}
    if texts["feature_map"] == LEARNED:
        del texts["feature_map"]  # one that is learned
    # GymV21Environment and GymV26Environment make what their env_id names.
    return {n: t for n, t in texts.items() if (":" in t or t.startswith("GymV") if n == "env" else t)}


def with_trusted(values: Mapping[str, Any], trusted: Mapping[str, str | None], source: str | Path) -> dict[str, Any]:
    """Settings of a file, with those that the command line names in their place."""
    named = {name: value for name, value in trusted.items() if value is not None}
    for name, text in importing(values).items():
        if name not in named:
            raise ValueError(
                f"{source} names the {IMPORTING[name]} {text!r}, which would import a module. If you trust it, pass "
                f"{flag(name)} {text}."
            )
    return {**values, **named}


def flag(name: str) -> str:
    """How the command line spells a setting."""
    return f"--{name.replace('_', '-')}"


def with_flags(text: str) -> str:
    """A message of the library in the words of the command line: ``--max-options`` for ``max_options``."""
    groups = {f.name: group for group, of in GROUPS.items() for f in dataclasses.fields(of)}

    def as_flag(found: re.Match[str]) -> str:
        name, value = found[1], found[2]
        if (name not in FIELDS and name not in groups) or not (value or "_" in name):
            return found[0]
        return flag(name if name in FIELDS else f"{groups[name]}.{name}") + (f" {value}" if value else "")

    for script, words in SPELT.items():
        text = text.replace(script, words)
    return re.sub(r'(\w+)(?:="?([\w:.]*\w)"?)?', as_flag, text)


def program() -> str:
    """What to type before a command: ``sb3-options``, ``python -m sb3_options`` or ``python train.py``."""
    name = Path(sys.argv[0]).name
    return {"sb3-options": name, "__main__.py": "python -m sb3_options"}.get(name, "python train.py")
