"""Options inside SB3's ``model.zip``: a model that has learned to choose options is useless without them.

SB3's ``save`` writes the attributes of a model, and its ``load`` restores them. So a model carries the content of its
options file as text. Saving the model saves the options, and a callback can put them back into an environment.
"""

import os
import weakref
from pathlib import Path
from typing import Any, TypeVar, cast

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.execution.above import monitor_primitive_steps
from sb3_options.learning.checks import check_wrapped
from sb3_options.options.archive import CARRIED, Source, content_in, packed_text, unpacked_text
from sb3_options.options.bank import OptionBank
from sb3_options.options.file import opened
from sb3_options.options.option import SubgoalOption

M = TypeVar("M", bound=BaseAlgorithm)


def load_model(algorithm: type[M], path: str | os.PathLike[str], env: gym.Env[Any, Any] | VecEnv, **kwargs: Any) -> M:
    """Load a model, and put its options into the environment it is to act in.

    A ``Monitor`` above the options, such as SB3 puts around an environment without one, counts primitive steps. SB3's
    ``load`` unpickles: use it for files that you trust.

    Args:
        algorithm: ``DQN``, ``MaskablePPO`` …
        path: File ``model.zip``, saved during or after a training with a callback of this library.
        env: Environment in an `OptionsWrapper`.
        **kwargs: Arguments of ``algorithm.load``.

    Returns:
        The model, with ``env`` as its environment.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds no options or does not fit the environment, or its weights are not finite.
    """
    path = Path(path)
    if not path.is_file() and path.suffix != ".zip":
        path = Path(f"{os.fspath(path)}.zip")  # as SB3 does
    content = content_in(path)
    model = algorithm.load(path, env=env, **kwargs)
    check_finite(model, path)
    venv = cast("VecEnv", model.get_env())
    load_options(content, venv)
    keep_options(model, venv.get_attr("bank", [0])[0])
    return model


def check_finite(model: BaseAlgorithm, path: Path) -> None:
    """Refuse a loaded model with weights that are NaN or infinite."""
    for name, weights in model.policy.state_dict().items():
        if weights.is_floating_point() and not weights.isfinite().all():
            raise ValueError(f"{path} holds weights that are NaN or infinite, {name}: training has diverged.")


def load_options(source: Source, env: gym.Env[Any, Any] | VecEnv) -> None:
    """Put the options of a file into the slots of an environment, also in worker processes.

    A ``Monitor`` above the options then counts primitive steps, and sums their rewards undiscounted.

    Args:
        source: Path of an options file or of a ``model.zip``.
        env: Environment in an `OptionsWrapper`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds no options, these do not fit, or the environment is not wrapped.
    """
    content = content_in(source)
    venv = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    check_wrapped(venv, "The environment")
    _put(content, venv)
    monitor_primitive_steps(venv)


def _put(content: bytes, venv: VecEnv) -> None:
    """Put the discovered options of a file into the slots of all environments."""
    bank: OptionBank = venv.get_attr("bank", [0])[0].copy()
    bank.load(content)
    options = {slot: bank[slot] for slot in opened(content).slots}
    learned = bank.feature_map
    venv.env_method(
        "set_slots",
        options={slot: each.bind(None) for slot, each in options.items() if isinstance(each, SubgoalOption)},
        learned_map=learned.arrays() if isinstance(learned, LearnedMap) and options else None,
    )


def put_back(model: BaseAlgorithm, venv: VecEnv) -> None:
    """Put the options that a model carries into environments that lack them.

    Either SB3 has loaded the model, or ``set_env`` gave it other environments with only empty slots. If only hand-made
    options are missing in the second case, there is just a warning.
    """
    text = getattr(model, CARRIED, None)
    known = _carried_for.get(model)
    if text is None or (known is not None and known() is venv):
        return
    content = unpacked_text(text)
    file = opened(content)
    filled = venv.get_attr("bank", [0])[0].filled
    if (known is None and not file.slots <= set(filled)) or (known is not None and not filled and file.entries):
        _put(content, venv)


def keep_options(model: BaseAlgorithm, bank: OptionBank) -> None:
    """Let the model carry the present options of its environment."""
    setattr(model, CARRIED, packed_text(bank.content()))
    _carried_for[model] = weakref.ref(cast("VecEnv", model.get_env()))


_carried_for: weakref.WeakKeyDictionary[BaseAlgorithm, weakref.ref[VecEnv]] = weakref.WeakKeyDictionary()
"""The environment that holds the options that a model carries; none for a model that SB3 has just loaded."""
