"""The tree of callbacks that ``learn`` was given."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv


def all_callbacks(root: BaseCallback | None) -> Iterator[BaseCallback]:
    """Yield every callback in the tree that ``learn`` was given."""
    if root is None:
        return
    yield root
    children: list[BaseCallback | None] = []
    if isinstance(root, CallbackList):
        children += root.callbacks
    if isinstance(root, EventCallback):
        children += [root.callback, getattr(root, "callback_on_new_best", None)]
    for child in children:
        yield from all_callbacks(child)


def check_every_step(callback: BaseCallback) -> None:
    """Refuse a callback inside another one, which may not call it at every step, as ``EveryNTimesteps``."""
    called: list[BaseCallback | None] = [callback.locals.get("callback")]
    for each in called:
        if isinstance(each, CallbackList):
            called += each.callbacks
    if called[0] is not None and callback not in called:
        name = type(callback).__name__
        raise ValueError(
            f"{name} is inside another callback, and has to see every step: pass it to learn() itself, "
            f"model.learn(..., callback=[..., {name}()])."
        )


def evaluation_envs(root: BaseCallback | None) -> list[VecEnv]:
    """Return the environments of every ``EvalCallback`` in the tree that ``learn`` was given."""
    return [each.eval_env for each in all_callbacks(root) if isinstance(each, EvalCallback)]
