"""The missions of BabyAI: instructions by a small grammar, as numbers, and the things that the first one names."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sb3_options.envs.minigrid.missions import COLOURS, NO_THING, bytes_of
from sb3_options.envs.minigrid.retina import BALL, BOX, DOOR, KEY

VERBS = ("open", "go to", "pick up", "put")
KINDS = {"object": 0, "door": DOOR, "key": KEY, "ball": BALL, "box": BOX}
"""What an instruction calls a thing; 0 is any object."""

PLACES = ("in front of you", "behind you", "on your left", "on your right")
"""Where a thing was when the episode began."""

WORDS = (VERBS, *2 * (COLOURS, tuple(KINDS), PLACES))
"""Of one instruction: the verb, and of the thing, and of the one it is put next to, the colour, kind and place."""

BEGINS = np.cumsum([0, *map(len, WORDS)])
"""Where each of `WORDS` begins in the code of an instruction, and in the end its length."""

AT_ONCE = 2
"""Instructions that "and" joins at most, on either side of "then"."""

REMEMBERED = 1 << 12
"""Missions whose code, and codes whose things, are kept: every step asks for those of its mission."""

_A_THING = rf"(?:a|the) (?:({'|'.join(COLOURS)}) )?({'|'.join(KINDS)})(?: ({'|'.join(PLACES)}))?"
_INSTRUCTION = re.compile(rf"({'|'.join(VERBS)}) {_A_THING}(?: next to {_A_THING})?")

Vector = npt.NDArray[np.uint8]


class Instructions:
    """The missions of BabyAI (Chevalier-Boisvert et al. 2019, §3.2), of one to four instructions.

    A code holds the words of each, one-hot, in the order in which they are to be followed: "go to the ball after you
    open a door" has the code of "open a door, then go to the ball". Articles are left out.
    """

    n_words = 2 * AT_ONCE * int(BEGINS[-1])
    """Length of a code."""

    n_things = 2
    """The thing of the first instruction, and the one that it is put next to."""

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def code(text: str) -> Vector | None:
        """The code of a mission, (`n_words`,); None if it is none of BabyAI."""
        later, after, sooner = text.partition(" after you ")
        sides = [sooner, later] if after else text.split(", then ")
        together = [side.split(" and ") for side in sides]
        if len(sides) > 2 or max(map(len, together)) > AT_ONCE:
            return None
        code = np.zeros((2, AT_ONCE, BEGINS[-1]), dtype=np.uint8)
        for rows, instructions in zip(code, together, strict=False):
            for row, instruction in zip(rows, instructions, strict=False):
                found = _INSTRUCTION.fullmatch(instruction)
                if found is None:
                    return None
                for word, words, begin in zip(found.groups(), WORDS, BEGINS, strict=False):
                    if word is not None:
                        row[begin + words.index(word)] = 1
        code.setflags(write=False)  # it is handed out again
        return code.ravel()

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def things_in(code: bytes) -> bytes:
        """The things that the first instruction names by colour, by the bytes of a code, for `things_of`."""
        first = np.frombuffer(code, np.uint8)[: BEGINS[-1]]
        colours, kinds = ([_word(first, i) for i in of] for of in ((1, 4), (2, 5)))
        objects = [*KINDS.values(), 0]
        return bytes_of(
            [(objects[kind], colour) if colour >= 0 else NO_THING for colour, kind in zip(colours, kinds, strict=True)]
        )


def _word(instruction: Vector, i: int) -> int:
    """Which word of `WORDS[i]` an instruction has; -1 for none."""
    chosen = instruction[BEGINS[i] : BEGINS[i + 1]]
    return int(chosen.argmax()) if chosen.any() else -1
