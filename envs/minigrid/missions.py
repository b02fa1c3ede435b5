"""The missions of a MiniGrid environment: their words as numbers, and the things that they name by colour."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_options.envs.minigrid.retina import BALL, BOX, DOOR, KEY, MOST_ASKED

MAX_MISSIONS = 4096  # of one environment
COLOURS = ("red", "green", "blue", "purple", "yellow", "grey")  # as in ``minigrid.core.constants.COLOR_TO_IDX``

# Names of coloured things in missions. A room is located by its door.
NAMED = {"door": DOOR, "room": DOOR, "key": KEY, "ball": BALL, "box": BOX}
# A coloured thing, but no goal, which is always green and a kind of its own.
_THING = re.compile(rf"\b({'|'.join(COLOURS)})\b(?! goal\b)(?: ({'|'.join(NAMED)})\b)?")
NO_THING = (0, -1)  # placeholder for a thing that a mission does not name

Vector = npt.NDArray[np.uint8]


class Missions:
    """All possible missions of an environment.

    Args:
        space: Its ``MissionSpace``; None if missions do not count.

    Attributes:
        codes: The variable words of each mission, one-hot, (n, w); w is 0 if there is only one mission.
        n_things: Maximum number of things that a mission names by colour, k.

    Raises:
        ValueError: Missions cannot be listed, or are too many.
    """

    def __init__(self, space: Any) -> None:
        self.codes = np.zeros((1, 0), dtype=np.uint8)
        texts = [""]
        if space is not None:
            self.codes, texts = _listed(space)
        self._number = {text: i for i, text in enumerate(texts)}
        named = [_things(text) for text in texts]
        self.n_things = max(map(len, named))
        self._nothing = bytes_of([NO_THING] * self.n_things)
        rows = [bytes_of(things + [NO_THING] * (self.n_things - len(things))) for things in named]
        self._things = {code.tobytes(): row for code, row in zip(self.codes, rows, strict=True)}

    @property
    def n_words(self) -> int:
        """Length of a code."""
        return int(self.codes.shape[1])

    def code(self, text: str) -> Vector | None:
        """Return the code of a mission, (w,); None if it is unknown."""
        number = self._number.get(text)
        return None if number is None else self.codes[number]

    def things_in(self, code: bytes) -> bytes:
        """Return the things that the mission of a code names by colour, for `things_of`."""
        return self._things.get(code, self._nothing)


def bytes_of(things: Sequence[tuple[int, int]]) -> bytes:
    """Pack objects and colours, for `things_of`."""
    return np.array(things, dtype=np.int64).tobytes()


def things_of(named: Sequence[bytes]) -> npt.NDArray[np.int64]:
    """Unpack object and colour of the things that missions name, (batch, k, 2).

    The object is 0 for any thing of the colour. The colour is -1 if a mission names fewer things than others.
    """
    return np.frombuffer(b"".join(named), np.int64).reshape(len(named), -1, 2)


def _listed(space: Any) -> tuple[Vector, list[str]]:
    """Return the codes and texts of all missions of a space."""
    from minigrid.core.mission import MissionSpace

    if type(space) is not MissionSpace:
        raise ValueError(
            f"The missions of {type(space).__name__} cannot be listed, so their words cannot be observed. Leave them "
            "out by mission=False (train.py --env-kwargs mission:False); then the agent does not know which of its "
            "tasks it is in."
        )
    words = [sorted(set(place)) for place in space.ordered_placeholders or ()]
    n = int(np.prod([len(place) for place in words]))
    if n > MAX_MISSIONS:
        raise ValueError(f"The environment has {n} missions, at most {MAX_MISSIONS} can be told apart.")
    eyes = [np.eye(len(place), dtype=np.uint8) for place in words]
    texts, codes = [], []
    for chosen in itertools.product(*words):
        texts.append(space.mission_func(*chosen))
        of_words = [eye[place.index(word)] for eye, place, word in zip(eyes, words, chosen, strict=True)]
        codes.append(np.concatenate([np.zeros(0, dtype=np.uint8), *of_words]))
    return np.array(codes), texts


def _things(text: str) -> list[tuple[int, int]]:
    """Return the first things that a mission names by colour, in order, without duplicates."""
    found = [(NAMED.get(name, 0), COLOURS.index(colour)) for colour, name in _THING.findall(text)]
    return list(dict.fromkeys(found))[:MOST_ASKED]
