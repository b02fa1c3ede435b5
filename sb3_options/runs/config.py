"""The settings of a training run: one class, its defaults, and files of settings.

Nothing here imports torch or Stable-Baselines3, so the help appears at once. `algorithms` checks the arguments of SB3's
classes.
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, TypeAdapter

from sb3_options.checked import Field, settings
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.embedding.settings import LEARNED
from sb3_options.experience.success import judged, success_rule
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
"""Module and class of each algorithm. The first is the default: it starts options only in their initiation sets."""

CLONING = ("maskableppo", "ppo", "a2c", "trpo")  # their policies sample, and can be cloned from demonstrations

CLONED = {"ent_coef": 0.0, "learning_rate": 0.0003, "max_runs": 5}
"""Settings for a cloned policy: an entropy bonus or large updates would undo the cloning. The limit is for a policy
with masks. An option that is learned anew becomes available where the policy was not cloned, and may be chosen there
again and again."""

OFF_POLICY = ("dqn", "qrdqn", "optiondqn")

# For action values that were fitted to demonstrations: random actions would leave the demonstrated way.
FITTED = {"exploration_initial_eps": 0.05, "learning_starts": 0}

REFINED = ("maskableppo", "ppo")  # take smaller updates from `MANY` demonstrations on: measured, or similar to these

CLONED_FROM_MANY = CLONED | {"learning_rate": 0.0001, "max_runs": 15}
"""The same from `MANY` demonstrations on. Larger updates make a good policy worse, and options are not learned anew
while it succeeds. In one demonstration of KeyCorridorS6R3 an option may run seven times."""

MAX_SEED = 2**32 - 1  # largest seed that NumPy's generators, which SB3 seeds, accept

# Limits above the needs of any run. Larger numbers in a stranger's file would only use up memory.
MAX_ENVS = 10_000
MAX_OPTIONS = 10_000

IMPORTING = {"env": "environment", "env_wrapper": "wrapper", "feature_map": "feature map"}
"""Settings that may import a module, and their meanings. Only the command line is trusted with them."""

Natural: TypeAlias = Annotated[int, Field(ge=0)]
Count: TypeAlias = Annotated[int, Field(ge=1)]


def _named_rule(text: str) -> str:
    """Check that the text of ``--success`` names a rule."""
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
        demonstrations: File of demonstrations.
        clone: Whether the policy begins with their decisions.
        max_options: Number of option slots.
        max_new_options: Maximum to discover; None: all slots.
        max_runs: Maximum runs of an option per episode.
        eval_freq: Primitive steps per evaluation; 0: none.
        tensorboard_log: Folder for run folders.
        gamma: Discount γ per primitive step.
        algo_kwargs: Arguments of SB3's class.
        env_wrapper: Wrapper of the environment, module:Class.
        feature_map: φ: module:function, or temporal-distance.
        bonus: Intrinsic reward: none, counts, rnd, noveld or e3b.
        success: Rule: terminated, return:30 or steps:500.
        checkpoint_freq: Primitive steps per checkpoint; 0: none.
        eval_episodes: Episodes of an evaluation.
        vec_env: Where environments run: dummy, subproc or ray.
        progress: Whether to show a progress bar.
        discovery: How subgoals are found.
        option: How options are learned.
        usefulness: How options are judged by their use.
    """

    algo: str = "maskableppo"
    env: str = "sb3_options/TwoRooms-v0"
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    n_timesteps: Count = 60_000
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)] = 0
    n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 8
    options: Path | None = None
    demonstrations: Path | None = None
    clone: bool = True
    max_options: Annotated[int, Field(ge=0, le=MAX_OPTIONS)] = 4
    max_new_options: Natural | None = 1
    max_runs: Count | None = None
    eval_freq: Natural = 0
    tensorboard_log: Path = Path("runs")
    gamma: Annotated[float, Field(gt=0.0, le=1.0)] = 0.97
    algo_kwargs: dict[str, Any] = field(default_factory=dict)
    env_wrapper: str | None = None
    feature_map: str | None = None
    bonus: Literal["none", "counts", "rnd", "noveld", "e3b"] = "none"
    success: Annotated[str, AfterValidator(_named_rule)] = "reported"
    checkpoint_freq: Natural = 10_000
    eval_episodes: Count = 10
    vec_env: Literal["dummy", "subproc", "ray"] = "dummy"
    progress: bool = True
    discovery: DiscoverySettings = field(default_factory=DiscoverySettings)
    option: OptionLearningSettings = field(default_factory=OptionLearningSettings)
    usefulness: UsefulnessSettings = field(default_factory=UsefulnessSettings)


FIELDS = {f.name: f for f in dataclasses.fields(TrainConfig)}
GROUPS = {"discovery": DiscoverySettings, "option": OptionLearningSettings, "usefulness": UsefulnessSettings}
"""Settings that are classes of settings themselves."""

SETTINGS = (*(f"{group}.{f.name}" for group, of in GROUPS.items() for f in dataclasses.fields(of)), *FIELDS)
"""Full names of all settings."""

HOW_IT_RAN = frozenset({"checkpoint_freq", "progress", "tensorboard_log", "vec_env"})  # without effect on learning
ARGUMENT = "algo_kwargs."  # prefix of the full names of an algorithm's arguments
SIMILAR = 0.7  # minimum similarity of `difflib` for a suggested word: ``sac`` is not ``a2c``
CONFIG = "config.yml"  # settings file in a run folder
OWN = ("algo", "algo_kwargs", "n_envs")  # settings that a file gives for its own algorithm only


def configure(**values: Any) -> TrainConfig:
    """Make a configuration of these settings, and of the environment's and algorithm's defaults for the rest."""
    return build(values, "settings")


def build(values: Mapping[str, Any], source: str | Path) -> TrainConfig:
    """Make a configuration, as `configure`. Errors begin with ``source``; names may have hyphens or a group's dot."""
    try:
        given = _flat(values)
        of_env = _flat(_tuned(str(given.get("env", TrainConfig.env))))
        algo = str(given.get("algo", of_env.get("algo", TrainConfig.algo)))
        check_algo(algo)
        defaults: dict[str, Any] = {}
        for names, block in shipped("defaults.yml").items():
            if algo in names.split():
                defaults |= _flat(block)
        # The environment's settings may name arguments of another algorithm.
        defaults |= {n: v for n, v in of_env.items() if n in defaults or not n.startswith(ARGUMENT)}
        clones = given.get("demonstrations") and given.get("clone", True)
        if clones and algo in OFF_POLICY:
            defaults |= _flat(FITTED)
        if clones and algo in CLONING:
            cloned = _flat(CLONED_FROM_MANY if algo in REFINED and _are_many(given) else CLONED)
            whole = getattr(given.get("discovery"), "segmentation", None)
            if algo != "maskableppo" or "peaks" in (whole, (defaults | given).get("discovery.segmentation")):
                del cloned["max_runs"]  # peaks are for tasks without episodes
            defaults |= {name: value for name, value in cloned.items() if name in {*defaults, "max_runs"}}
        own = _nested(given)["algo_kwargs"]
        if own:
            from sb3_options.runs.algorithms import checked_arguments  # which imports SB3

            own = checked_arguments(algo, own)
        arguments = _with_layers(_nested(defaults)["algo_kwargs"], own)
        return TrainConfig(**_nested(defaults | given) | {"algo": algo, "algo_kwargs": arguments})
    except ValueError as error:
        raise ValueError(f"{source}: {str(error).removeprefix('TrainConfig: ')}") from None


def _are_many(given: Mapping[str, Any]) -> bool:
    """Return whether `MANY` demonstrations succeed, unless the file decides nothing.

    Training says what is wrong with a file that cannot be read, and `TrainConfig` with a value that is no path or rule.
    """
    path, rule = given["demonstrations"], given.get("success", TrainConfig.success)
    decided = {ARGUMENT + "learning_rate", "max_runs"} <= given.keys()  # as in every saved configuration
    if decided or not (isinstance(path, str | Path) and isinstance(rule, str) and Path(path).is_file()):
        return False
    from sb3_options.checkpoints.demonstrations import MANY, load_demonstrations  # only where there are some

    try:
        return sum(judged(success_rule(rule), each) for each in load_demonstrations(path)) >= MANY
    except (OSError, ValueError):
        return False


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by full names: ``gamma``, ``discovery.decay``, ``algo_kwargs.n_steps``."""
    flat: dict[str, Any] = {}
    for spelling, value in values.items():
        name = str(spelling).replace("-", "_")
        name = "discovery.method" if name == "method" else name
        if isinstance(value, Mapping) and name in (*GROUPS, "algo_kwargs"):
            flat |= {f"{name}.{str(key).replace('-', '_')}": each for key, each in value.items()}
        elif (name in FIELDS and name != "algo_kwargs") or "." in name:
            flat[name] = value
        else:
            flat[f"{ARGUMENT}{name}"] = value
    for name in flat.keys() - set(SETTINGS):
        if not name.startswith(ARGUMENT):
            raise ValueError(unknown(name))
    return flat


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by the names of `TrainConfig`. A group given as an object replaces its parts."""
    fields = {name: value for name, value in flat.items() if name in FIELDS}
    for group in (*GROUPS, "algo_kwargs"):
        part = {name.removeprefix(f"{group}."): v for name, v in flat.items() if name.startswith(f"{group}.")}
        fields.setdefault(group, part)
    return fields


def _with_layers(before: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    """Merge arguments of the algorithm, later ones over earlier ones; ``net_arch`` goes into policy_kwargs."""
    both = {**before, **later}
    policy: dict[str, Any] = {}
    for each in (before, later):
        policy |= each.get("policy_kwargs") or {}
        policy |= {"net_arch": list(each["net_arch"])} if "net_arch" in each else {}
    both.pop("net_arch", None)
    return both | ({"policy_kwargs": policy} if policy else {})


def _tuned(env_id: str) -> dict[str, Any]:
    """Return the shipped settings for an environment."""
    if env_id.removeprefix("minigrid:").startswith(("MiniGrid-", "BabyAI-")):  # MiniGrid's own test is slow to import
        return shipped("tuned/minigrid.yml")
    return shipped("tuned/pioneer.yml") if env_id.startswith("sb3_options/Pioneer") else {}


@cache
def shipped(file: str) -> dict[str, Any]:
    """Read a settings file that ships with the library."""
    return yaml_file.read_mapping(Path(__file__).parent / file)


def check_algo(algo: str, commands: Iterable[str] = ()) -> None:
    """Refuse an unknown algorithm, which may be a mistyped command."""
    if algo not in ALGORITHMS:
        hint = near(algo, {name: name for name in (*ALGORITHMS, *commands)})
        names = ", ".join(ALGORITHMS)
        raise ValueError(f"There is no algorithm {algo!r}. Options need discrete actions: choose from {names}.{hint}")


def unknown(name: str, arguments: Iterable[str] = ()) -> str:
    """Return the message for an unknown setting, with the nearest known one."""
    known = {each.rpartition(".")[2]: each for each in (*SETTINGS, *arguments)}
    return f"there is no setting {name!r}.{near(name.rpartition('.')[2], known)}"


def near(word: str, known: Mapping[str, str]) -> str:
    """Return a question that suggests a similar known word; empty if there is none."""
    found = difflib.get_close_matches(word, known, n=1, cutoff=SIMILAR)
    return f" Did you mean {known[found[0]]!r}?" if found else ""


def load(path: Path, trusted: Mapping[str, str | None] | None = None) -> TrainConfig:
    """Read a configuration that `save` wrote."""
    return build(read(path, trusted), path)


def save(config: TrainConfig, path: Path) -> None:
    """Write a configuration as YAML that ``--config`` reads back."""
    yaml_file.write(path, as_values(config))


def as_values(config: TrainConfig) -> dict[str, Any]:
    """Return all settings by name, as JSON values."""
    return dict(TypeAdapter(TrainConfig).dump_python(config, mode="json"))


def read(path: Path, trusted: Mapping[str, str | None] | None = None) -> dict[str, Any]:
    """Read settings from a file, unchecked; ``trusted`` are `IMPORTING` settings from the command line."""
    values = {str(name).replace("-", "_"): value for name, value in yaml_file.read_mapping(path).items()}
    return with_trusted(values, trusted or {}, path)


def importing(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the settings in ``values`` that would import a module, by name."""
    texts = {name: str(values.get(name) or "") for name in IMPORTING}
    if texts["feature_map"] == LEARNED:
        del texts["feature_map"]  # learned, not imported
    # GymV21Environment and GymV26Environment make what their env_id names.
    return {n: t for n, t in texts.items() if (":" in t or t.startswith("GymV") if n == "env" else t)}


def with_trusted(values: Mapping[str, Any], trusted: Mapping[str, str | None], source: str | Path) -> dict[str, Any]:
    """Replace settings of a file by trusted ones; refuse others that would import a module."""
    named = {name: value for name, value in trusted.items() if value is not None}
    for name, text in importing(values).items():
        if name not in named:
            raise ValueError(
                f"{source} names the {IMPORTING[name]} {text!r}, which would import a module. If you trust it, pass "
                f"{flag(name)} {text}."
            )
    return {**values, **named}


def flag(name: str) -> str:
    """Spell a setting as on the command line."""
    return f"--{name.replace('_', '-')}"


def program() -> str:
    """Return the words before a command: ``sb3-options``, ``python -m sb3_options`` or ``python train.py``."""
    name = Path(sys.argv[0]).name
    return {"sb3-options": name, "__main__.py": "python -m sb3_options"}.get(name, "python train.py")
