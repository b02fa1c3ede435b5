"""Experts that know the whole state of an environment: of MiniGrid, of the paper's rooms, and of Taxi."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np

from experiments.deep.tasks import steps_after
from experiments.methods.tasks import steps_to_deliver

Cell = tuple[int, int]

Policy: TypeAlias = Callable[[Any], int]
"""Observation → action."""

MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Of the agent's four directions."""

WITHOUT_BOT = ("UnlockToUnlock",)
"""Levels in which the BabyAI bot may plan without end."""


def expert_of(env: gym.Env[Any, Any], noise: float = 0.0, seed: int = 0) -> Policy:
    """A policy: MiniGrid's own BabyAI bot, where it can solve the task, or else `planned`.

    Args:
        env: The environment that it acts in.
        noise: Share of its actions that are random.
        seed: Of these.
    """
    from minigrid.envs.babyai.core.roomgrid_level import RoomGridLevel
    from minigrid.utils.baby_ai_bot import BabyAIBot

    game: Any = env.unwrapped
    has_bot = isinstance(game, RoomGridLevel) and type(game).__name__ not in WITHOUT_BOT
    random = np.random.default_rng(seed)
    bot: Any = None
    last: Any = None

    def act(_: Any) -> int:
        nonlocal bot, last
        if not has_bot:
            last = planned(game)
        else:
            if game.step_count == 0:
                bot, last = BabyAIBot(game), None  # type: ignore[no-untyped-call]
            try:
                last = bot.replan(last)
            except AssertionError:
                if not noise:
                    raise
                # Random actions have blocked its way: another one, and think anew.
                bot, last = BabyAIBot(game), None  # type: ignore[no-untyped-call]
                return int(random.integers(len(game.actions)))
        if random.random() < noise:
            last = game.actions(random.integers(len(game.actions)))
        return int(last)

    return act


def room_expert(env: gym.Env[Any, Any], noise: float = 0.0, seed: int = 0) -> Policy:
    """The best policy of a gridworld with one-hot observations; arguments as of `expert_of`."""
    world: Any = env.unwrapped
    best = steps_after(world).argmin(axis=0)
    return _erring(lambda observation: int(best[observation.argmax()]), int(world.action_space.n), noise, seed)


def taxi_expert(env: gym.Env[Any, Any], noise: float = 0.0, seed: int = 0) -> Policy:
    """The best policy of Taxi; arguments as of `expert_of`."""
    taxi: Any = env.unwrapped
    steps = steps_to_deliver(taxi)

    def best(_: Any) -> int:
        led = {action: -1 if ended else steps[state] for action, ((_, state, _, ended),) in taxi.P[taxi.s].items()}
        return int(min(led, key=led.__getitem__))

    return _erring(best, int(taxi.action_space.n), noise, seed)


def _erring(policy: Policy, n_actions: int, noise: float, seed: int) -> Policy:
    random = np.random.default_rng(seed)
    return lambda observation: int(random.integers(n_actions)) if random.random() < noise else policy(observation)


def planned(game: Any) -> int:
    """The next action towards `game.obj`, the goal or a ball. Keys of locked doors on the way come first."""
    kinds = game.actions
    things = _things(game)
    ends = [thing for of in ("goal", "ball") for _, thing in things if thing.type == of]
    goal = getattr(game, "obj", None) or ends[0]
    target = next(cell for cell, thing in things if thing is goal)
    action = kinds.forward if game.grid.get(*target).type == "goal" else kinds.pickup
    held = game.carrying
    way = _way(game, target)
    while (door := _locked(game, way)) is not None and not (held is not None and held.color == door.color):
        target = next(cell for cell, thing in _things(game) if _is_key(thing, door.color) or _hides(thing, door.color))
        action = kinds.pickup if game.grid.get(*target).type == "key" else kinds.toggle
        way = _way(game, target)
    if way[0] == target and action == kinds.pickup and held is not None:
        return int(kinds.drop if tuple(game.front_pos) in _free(game) else kinds.left)
    ahead = game.grid.get(*way[0])
    turns = (MOVES.index((way[0][0] - game.agent_pos[0], way[0][1] - game.agent_pos[1])) - game.agent_dir) % 4
    if turns:
        return int(kinds.left if turns == 3 else kinds.right)
    if way[0] == target:
        return int(action)
    return int(kinds.toggle if ahead is not None and ahead.type == "door" and not ahead.is_open else kinds.forward)


def _things(game: Any) -> list[tuple[Cell, Any]]:
    cells = [(x, y) for x in range(game.width) for y in range(game.height)]
    return [(cell, thing) for cell in cells if (thing := game.grid.get(*cell)) is not None and thing.type != "wall"]


def _way(game: Any, target: Cell) -> list[Cell]:
    """The cells of a shortest way to a target, through doors that may be locked, without the first.

    Where there is none, things on the way count as passable: what blocks it may be fetched before.
    """
    start: Cell = tuple(game.agent_pos)
    for passable in (("door", "goal"), ("door", "goal", "key", "box", "ball")):
        before: dict[Cell, Cell] = {start: start}
        waiting = deque([start])
        while waiting and target not in before:
            x, y = waiting.popleft()
            for dx, dy in MOVES:
                cell = x + dx, y + dy
                thing = game.grid.get(*cell)
                if cell not in before and (cell == target or thing is None or thing.type in passable):
                    before[cell] = x, y
                    waiting.append(cell)
        if target in before:
            break
    way = [target]
    while before[way[-1]] != start:
        way.append(before[way[-1]])
    return way[::-1]


def _locked(game: Any, way: list[Cell]) -> Any:
    """The first locked door on a way."""
    things = [game.grid.get(*cell) for cell in way]
    return next((each for each in things if each is not None and each.type == "door" and each.is_locked), None)


def _is_key(thing: Any, colour: str) -> bool:
    return bool(thing is not None and thing.type == "key" and thing.color == colour)


def _hides(thing: Any, colour: str) -> bool:
    return bool(thing.type == "box" and _is_key(thing.contains, colour))


def _free(game: Any) -> list[Cell]:
    """Cells beside the agent where something may be put, without blocking a door if that is possible."""
    x, y = game.agent_pos
    free = [(x + dx, y + dy) for dx, dy in MOVES if game.grid.get(x + dx, y + dy) is None]
    near = {cell: [game.grid.get(cell[0] + dx, cell[1] + dy) for dx, dy in MOVES] for cell in free}
    clear = [cell for cell in free if not any(each is not None and each.type == "door" for each in near[cell])]
    return clear or free
