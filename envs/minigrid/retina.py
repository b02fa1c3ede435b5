"""The concept space of MiniGrid: for each kind of thing, the place of the nearest one in view, relative to the agent.

It is computed from the standard observation, an image (v, v, 3) of object, colour and state of the cells in view. The
agent stands in the middle of the last row and looks towards the first. Nothing is read from the simulator.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_options.envs.minigrid.cells import COLOURS, DEPTH, OBJECTS

# Objects, and states of a door, numbered as in ``minigrid.core.constants``; ``FREE`` is empty and floor.
WALL, FREE, DOOR, KEY, BALL, BOX, GOAL, LAVA = 2, (1, 3), 4, 5, 6, 7, 8, 9
OPEN, CLOSED, LOCKED = 0, 1, 2

KINDS = ("closed_door", "open_door", "locked_door", "key", "ball", "box", "goal", "lava")
"""The kinds of things. A carried thing is at 0, 0, where MiniGrid draws it."""

# Features of the cells around the agent: 1 or 0. Between walls on its left and right, it is in a doorway or corridor.
# MiniGrid does not draw the door that the agent stands in.
AHEAD = ("wall_ahead", "free_ahead", "between_walls")
THING = ("visible", "forward", "lateral")  # features of a thing: whether it is in view, and where

FEATURES = (*(f"{kind}_{what}" for kind in KINDS for what in THING), *AHEAD)
"""The names of the features, in order. ``visible`` is 1 or 0. ``forward`` is in cells, ≥ 0. ``lateral`` is in cells,
positive to the right. Both are 0 if nothing of the kind is visible. The nearest thing is the fewest steps away, so a
carried thing hides all others of its kind."""

SHUNNED = ("lava",)  # kinds without a group: dangers are rare too, and an option would lead the agent there
MOST_ASKED = 3  # things of a mission that φ locates. Every task has features for this many, so options fit all tasks.
COLOURED = (DOOR, KEY, BALL, BOX)  # objects that a mission may mean if it names only a colour
VISIBLE_SCALE = 10.0  # factor of the features that are 1 or 0: separates them by more than any radius

# Pairs of kinds that may matter together: a thing that is carried or lies around, and its use or what it blocks.
PAIRS = (("key", "locked_door"), ("key", "closed_door"), ("ball", "open_door"), ("box", "key"))

N_KINDS = len(KINDS)
_NOTHING = N_KINDS
OBJECT_FACTOR = 256  # in a cell's code: its object times this, plus its state


def _kinds() -> npt.NDArray[np.int8]:
    """Return the kind of a cell by its code."""
    kinds = np.full((256, OBJECT_FACTOR), _NOTHING, dtype=np.int8)
    for state, kind in ((CLOSED, "closed_door"), (OPEN, "open_door"), (LOCKED, "locked_door")):
        kinds[DOOR, state] = KINDS.index(kind)
    for thing, kind in ((KEY, "key"), (BALL, "ball"), (BOX, "box"), (GOAL, "goal"), (LAVA, "lava")):
        kinds[thing] = KINDS.index(kind)
    return kinds.ravel()


_THINGS = (DOOR, KEY, BALL, BOX, GOAL, LAVA)
_WALKED_ON = (*FREE, GOAL)
_KIND_OF = _kinds()
_KINDS_OF: list[int] = _KIND_OF.tolist()
_IS_WALL = np.repeat(np.arange(256) == WALL, OBJECT_FACTOR)
_IS_FREE = np.repeat(np.isin(np.arange(256), _WALKED_ON), OBJECT_FACTOR) | (KINDS.index("open_door") == _KIND_OF)
_COLOURED = np.isin(np.arange(256), COLOURED)


def retina(
    images: npt.NDArray[np.integer[Any]], asked: npt.NDArray[np.integer[Any]] | None = None
) -> npt.NDArray[np.float64]:
    """Return φ of a batch of MiniGrid images.

    Args:
        images: The ``image`` of each observation, (batch, v, v, 3), column, row and channel.
        asked: Object and colour of the things that each mission names, (batch, k, 2); object 0 for any of the colour.

    Returns:
        Features in the order of ``FEATURES``, then for each thing named whether the nearest is visible, and where,
        (batch, 27 + 3k).
    """
    images = np.asarray(images)
    if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[3] != 3:
        raise ValueError(f"images must have shape (batch, v, v, 3), as MiniGrid's are, got {images.shape}")
    n, view = images.shape[:2]
    objects, colours, states = images.reshape(n, view * view, 3).astype(np.intp).transpose(2, 0, 1)
    match = None if asked is None else _asked(objects, colours, asked)
    return retina_of_codes(objects * OBJECT_FACTOR + states, view, match)


def retina_of_codes(
    codes: npt.NDArray[np.intp], view: int, match: npt.NDArray[np.bool_] | None = None
) -> npt.NDArray[np.float64]:
    """Return the `retina` of the codes of the cells in a ``view`` v wide, (batch, v²).

    A code is `OBJECT_FACTOR` times the object plus the state. ``match`` says which cells hold the things that each
    mission names, (batch, k, v²).
    """
    n, n_cells = codes.shape
    sight = _sight(view)
    # Of equal indices numpy assigns the last, so the farthest cells come first.
    kind = _KIND_OF.take(codes.take(sight.farthest_first, axis=1))
    nearest = np.full((n, N_KINDS + 1), n_cells)
    nearest[np.arange(n)[:, None], kind] = sight.countdown
    nearest = nearest[:, :_NOTHING]
    if match is not None:
        match = match[..., sight.farthest_first[::-1]]
        found = np.where(match.any(axis=2), match.argmax(axis=2), n_cells)
        nearest = np.concatenate([nearest, found], axis=1)
    things = sight.places.take(nearest, axis=0).reshape(n, len(THING) * nearest.shape[1])
    ahead, left, right = codes.take(sight.around, axis=1).T
    first = len(THING) * N_KINDS
    features = np.empty((n, things.shape[1] + len(AHEAD)))
    features[:, :first] = things[:, :first]
    features[:, first + len(AHEAD) :] = things[:, first:]
    features[:, first] = _IS_WALL[ahead]
    features[:, first + 1] = _IS_FREE[ahead]
    features[:, first + 2] = _IS_WALL[left] & _IS_WALL[right]
    return features


def retina_of_one(cells: bytes, view: int, size: int, asked: Iterable[Sequence[int]] = ()) -> npt.NDArray[np.float64]:
    """Return the `retina` of one image, (1, size), for a step of an agent: numpy calls would take three times as long.

    ``cells`` is the one-hot code of each cell in a ``view`` v wide, v² · `DEPTH` bytes. ``asked`` are object and colour
    of the things that the mission names. Features of things that it does not name are 0.
    """
    sight = _sight(view)
    absent = view * view
    nearest = [absent] * (N_KINDS + 1)
    for thing in _THINGS:
        for cell in _ones(cells[thing::DEPTH]):
            first = cell * DEPTH + OBJECTS + COLOURS
            kind = _KINDS_OF[thing * OBJECT_FACTOR + cells.index(1, first) - first]
            nearest[kind] = min(nearest[kind], sight.ranks[cell])
    row = [number for rank in nearest[:_NOTHING] for number in sight.rows[rank]]
    ahead, left, right = (number * DEPTH for number in sight.neighbours)
    is_free = any(cells[ahead + thing] for thing in _WALKED_ON)
    is_open = cells[ahead + DOOR] and cells[ahead + OBJECTS + COLOURS + OPEN]
    row += cells[ahead + WALL], is_free or is_open, cells[left + WALL] and cells[right + WALL]
    for thing, colour in asked:
        wanted = [each for each in COLOURED if thing in (0, each)] if colour >= 0 else []
        found = _ones(cells[OBJECTS + colour :: DEPTH])
        ranks = (sight.ranks[cell] for cell in found if any(cells[cell * DEPTH + each] for each in wanted))
        row += sight.rows[min(ranks, default=absent)]
    row += [0.0] * (size - len(row))
    return np.array([row], dtype=np.float64)


def _ones(code: bytes) -> Iterator[int]:
    """Yield where a code of zeros and ones is 1."""
    cell = code.find(1)
    while cell >= 0:
        yield cell
        cell = code.find(1, cell + 1)


class _Sight(NamedTuple):
    """The cells of a view."""

    farthest_first: npt.NDArray[np.intp]  # (v²,) from the most steps from the agent, ties from the last column
    countdown: npt.NDArray[np.intp]  # v² − 1, ..., 0: the number of each of these cells, counted from the nearest
    places: npt.NDArray[np.float64]  # features of a thing in the cell of each such number, and of none, (v² + 1, 3)
    around: npt.NDArray[np.intp]  # the cells ahead, to the left and to the right
    ranks: list[int]  # each cell's number among the nearest
    rows: list[list[float]]  # `places`
    neighbours: list[int]  # `around`


@lru_cache
def _sight(view: int) -> _Sight:
    """Return the cells of a view, ``view`` cells wide."""
    middle, last = view // 2, view - 1
    columns, rows = np.divmod(np.arange(view * view), view)
    forward, lateral = last - rows, columns - middle
    order = np.argsort(forward + np.abs(lateral), kind="stable")
    around = np.array([middle * view + last - 1, (middle - 1) * view + last, (middle + 1) * view + last])
    places = np.zeros((view * view + 1, len(THING)))
    places[:-1] = np.stack([np.ones(view * view), forward[order], lateral[order]], axis=1)
    ranks = np.argsort(order).tolist()
    countdown = np.arange(view * view)[::-1].copy()
    return _Sight(order[::-1].copy(), countdown, places, around, ranks, places.tolist(), around.tolist())


def _asked(objects: npt.NDArray[Any], colours: npt.NDArray[Any], asked: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which cells hold the things named, (batch, k, cells)."""
    what, colour = asked[..., 0, None], asked[..., 1, None]
    coloured = _COLOURED[objects][:, None] & (colours[:, None] == colour)
    found: npt.NDArray[np.bool_] = coloured & ((what == 0) | (objects[:, None] == what))
    return found


def feature_names(n_asked: int = 0) -> tuple[str, ...]:
    """Return the names of all features, including ``n_asked`` things of a mission: asked, asked_2 and so on."""
    asked = ("asked" if i == 0 else f"asked_{i + 1}" for i in range(n_asked))
    return (*FEATURES, *(f"{name}_{what}" for name in asked for what in THING))


def concept_groups(n_asked: int = 0) -> list[dict[str, Any]]:
    """Return the feature groups: each kind of thing, ``PAIRS`` of kinds, a doorway, and things of the mission.

    Lava, which is to be avoided, has no group; its features are for groups of your own.

    In a doorway the agent is ``between_walls``, whatever is in view. It does not see the door that it stands in, but
    perhaps the next one.

    An option also sees ``free_ahead``, to go around a wall. An option into a doorway also sees open doors. An option to
    an open door also sees closed doors, because it can begin before the door is open. Places of things are coordinates:
    a step ahead brings things nearer, however far away they are.

    Args:
        n_asked: Number of things that a mission names.

    Returns:
        The fields of `sb3_options.density.groups.FeatureGroup` for each group.
    """
    groups = [_group(kind) for kind in (*KINDS, "doorway") if kind not in SHUNNED]
    groups += [_joined(_group(one), _group(other)) for one, other in PAIRS]
    asked = [name.removesuffix("_visible") for name in feature_names(n_asked)[len(FEATURES) :: 3]]
    return [_seeing(group) for group in groups + [_thing(name, len(FEATURES) + 3 * i) for i, name in enumerate(asked)]]


def _group(kind: str) -> dict[str, Any]:
    return _doorway() if kind == "doorway" else _thing(kind, 3 * KINDS.index(kind))


def _thing(kind: str, first: int) -> dict[str, Any]:
    features, present = [first, first + 1, first + 2], [first]
    scale, labels = [VISIBLE_SCALE, 1.0, 1.0], ["", *THING[1:]]
    return {"name": kind, "features": features, "present": [present], "scale": scale, "labels": labels}


def _doorway() -> dict[str, Any]:
    between = FEATURES.index("between_walls")
    return {
        "name": "doorway", "features": [between], "present": [[between]], "scale": [VISIBLE_SCALE], "labels": [""],
    }  # fmt: skip


def _seeing(group: dict[str, Any]) -> dict[str, Any]:
    """Add the features that its options see to a group."""
    ahead = FEATURES.index("free_ahead")
    features = [*group["features"], ahead]
    present = group["present"]
    scale = [*group["scale"], VISIBLE_SCALE]
    before = {"doorway": "open_door", "open_door": "closed_door"}.get(group["name"])
    if before is not None:
        door = _group(before)
        features, scale = features + door["features"], scale + door["scale"]
        present = [present[0] + door["present"][0]]
    # The first feature of each thing is its visibility, the other two are coordinates.
    coordinates = [each for each in features if each % 3 != 0 and not 3 * N_KINDS <= each < len(FEATURES)]
    seen = {"features": features, "present": present, "scale": scale, "coordinates": coordinates}
    return {**group, "seen": {"name": group["name"], **seen}}


def _joined(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    joined = {name: one[name] + other[name] for name in ("features", "present", "scale")}
    labels = [label and f"{of['name']} {label}" for of in (one, other) for label in of["labels"]]
    return {"name": f"{one['name']} and {other['name']}", **joined, "labels": labels}
