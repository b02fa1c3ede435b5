"""Options inside SB3's ``model.zip``: a model that has learned to choose options is nothing without them.

SB3's ``save`` writes a zip file of its own members. `keep_options` adds the options file as one more, which SB3's
``load`` passes over. ``load`` gives a model the entries of the member ``data``, so one of these holds the same content
as text: it is still there when SB3 alone has loaded the model, and a callback can put the options back.
"""

from __future__ import annotations

import io
import os
import weakref
import zipfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_options.atomic import atomic_write
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.execution.above import monitor_primitive_steps
from sb3_options.learning.checks import check_wrapped
from sb3_options.options.archive import CARRIED, NAME, Source, content_in, packed_text, unpacked_text
from sb3_options.options.bank import OptionBank
from sb3_options.options.file import slots_of
from sb3_options.options.option import SubgoalOption

M = TypeVar("M", bound=BaseAlgorithm)


def load_model(algorithm: type[M], path: str | os.PathLike[str], env: gym.Env[Any, Any] | VecEnv, **kwargs: Any) -> M:
    """Load a model and put its options into the environment it is to act in.

    The model's ``save`` keeps the options from then on. A ``Monitor`` above them, as SB3 puts around an environment
    that has none, counts primitive steps. SB3's ``load`` unpickles: use it for files that you trust.

    Args:
        algorithm: ``DQN``, ``MaskablePPO`` …
        path: Of a ``model.zip`` that was saved while a callback of this library was with the model, or after that.
        env: Wrapped in `OptionsWrapper`.
        **kwargs: For ``algorithm.load``.

    Returns:
        The model, with ``env`` as its environment.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no options, these do not fit the environment, or the algorithm cannot load it, as one that
            another saved; not every such model is told.
    """
    path = Path(path)
    if not path.is_file() and path.suffix != ".zip":
        path = Path(f"{os.fspath(path)}.zip")  # as SB3 does
    if not path.is_file():
        raise FileNotFoundError(f"There is no model at {path}.")
    content = content_in(path)
    try:
        model = algorithm.load(path, env=env, **kwargs)
    except ValueError as error:
        if "spaces do not match" not in str(error):
            raise
        raise ValueError(
            f"{path} does not fit the environment: {error}. It needs OptionsWrapper(env, max_options=...) with as many "
            "slots as in training, and the same environment beneath."
        ) from error
    except (AttributeError, TypeError) as error:  # what SB3 raises where the networks are another algorithm's
        raise ValueError(
            f"{path} could not be loaded by {algorithm.__name__}: {error}. If another algorithm saved it, load it with "
            "that one."
        ) from error
    check_finite(model, path)
    model.__dict__.pop(CARRIED, None)
    load_options(content, _env_of(model))
    keep_options(model)
    return model


def check_finite(model: BaseAlgorithm, path: Path) -> None:
    """Refuse a loaded model with weights that are NaN or infinite.

    Raises:
        ValueError: One is.
    """
    for name, weights in model.policy.state_dict().items():
        if weights.is_floating_point() and not weights.isfinite().all():
            raise ValueError(f"{path} holds weights that are NaN or infinite, {name}: training has diverged.")


def load_options(source: Source, env: gym.Env[Any, Any] | VecEnv) -> None:
    """Put the options of a file into the slots of an environment, also in worker processes.

    A ``Monitor`` above the options counts primitive steps from then on, and sums their rewards undiscounted.

    Args:
        source: Path of an options file or of a ``model.zip``.
        env: Wrapped in `OptionsWrapper`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no options, these do not fit, or the environment is not wrapped.
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
    options = {slot: bank[slot] for slot in slots_of(content)}
    learned = bank.feature_map
    venv.env_method(
        "set_slots",
        options={slot: each.bind(None) for slot, each in options.items() if isinstance(each, SubgoalOption)},
        learned_map=learned.arrays() if isinstance(learned, LearnedMap) and options else None,
    )


def put_back(model: BaseAlgorithm, venv: VecEnv) -> None:
    """Put the options that a model has learned to choose into those environments that lack them.

    It carries them since SB3 loaded it; or it was trained with them, or `load_model` loaded them, and ``set_env`` gave
    it other environments, whose slots are all empty.

    Raises:
        ValueError: They do not fit.
    """
    text, filled = model.__dict__.pop(CARRIED, None), venv.get_attr("bank", [0])[0].filled
    if text is not None:
        content = unpacked_text(text)
        if not set(slots_of(content)) <= set(filled):
            _put(content, venv)
    elif not filled and isinstance(save := model.__dict__.get("save"), _Save):
        left = save.left_in_others(venv)
        if left is not None:
            _put(left, venv)


def keep_options(model: BaseAlgorithm, bank: OptionBank | None = None) -> None:
    """Let the model's ``save`` write the options too, whoever calls it: a ``CheckpointCallback``, say.

    Args:
        model: Its environment is wrapped in `OptionsWrapper`.
        bank: The options; by default those in the model's environment when it is saved, or, where ``set_env`` gave it
            another without any, those in the last one.
    """
    model.save = _Save(model, bank)  # type: ignore[method-assign]  # it takes what save takes


class _Save:
    """Takes the place of a model's ``save``."""

    def __init__(self, model: BaseAlgorithm, bank: OptionBank | None) -> None:
        self._model, self._asks = model, bank is None
        self._venv = weakref.ref(_env_of(model))
        self._bank = _bank_of(model) if bank is None else bank

    def left_in_others(self, venv: VecEnv) -> bytes | None:
        """The options of the last training, or of `load_model`, if in other environments than these; None if none.

        None, too, where `load_model` or `PrimitiveStepsCallback` met hand-made ones only: these are code, and there is
        a warning where they are missing.
        """
        if venv is self._venv() or not self._bank.filled:
            return None
        comes_back = not self._asks or any(isinstance(option, SubgoalOption) for option in self._bank.slots)
        return self._bank.content() if comes_back else None

    def __call__(
        self,
        path: str | os.PathLike[str] | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """What ``BaseAlgorithm.save`` does, and the options; a file at ``path`` is replaced when all is written."""
        if self._asks:
            self._ask()
        without = [*(exclude or ()), "save"]
        if isinstance(path, io.BufferedIOBase):
            whole = io.BytesIO()
            self._write(whole, without, include)
            path.write(whole.getbuffer())
        else:
            path = Path(path)
            with (
                atomic_write(path if path.suffix else path.with_name(f"{path.name}.zip")) as temporary,
                temporary.open("wb+") as file,
            ):
                self._write(file, without, include)

    def _ask(self) -> None:
        """Look which options there are; where ``set_env`` gave environments without any, the last ones count."""
        with suppress(EOFError, OSError):  # worker processes have ended: these are the last options known
            venv, bank = _env_of(self._model), _bank_of(self._model)
            if bank.filled or venv is self._venv():
                self._venv, self._bank = weakref.ref(venv), bank

    def _write(self, file: io.BufferedIOBase, exclude: Iterable[str], include: Iterable[str] | None) -> None:
        content = self._bank.content()
        setattr(self._model, CARRIED, packed_text(content))
        try:
            type(self._model).save(self._model, file, exclude, include)
        finally:
            delattr(self._model, CARRIED)  # while it is in an environment with options, these are the model's
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr(NAME, content)


def _env_of(model: BaseAlgorithm) -> VecEnv:
    venv = model.get_env()
    if venv is None:
        raise ValueError("The model has no environment to put options into: pass env=.")
    return venv


def _bank_of(model: BaseAlgorithm) -> OptionBank:
    bank: OptionBank = _env_of(model).get_attr("bank", [0])[0]
    return bank
