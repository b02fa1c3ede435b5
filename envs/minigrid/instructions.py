"""The missions of BabyAI: instructions of a small grammar as numbers, and the things that the first one names."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sb3_options.envs.minigrid.missions import COLOURS, NO_THING, bytes_of
from sb3_options.envs.minigrid.retina import BALL, BOX, DOOR, KEY

VERBS = ("open", "go to", "pick up", "put")
KINDS = {"object": 0, "door": DOOR, "key": KEY, "ball": BALL, "box": BOX}  # names of things; 0 is any object
PLACES = ("in front of you", "behind you", "on your left", "on your right")  # at the start of the episode

# Words of one instruction: the verb, then colour, kind and place of the thing and of the thing to put it next to.
WORDS = (VERBS, *2 * (COLOURS, tuple(KINDS), PLACES))
BEGINS = np.cumsum([0, *map(len, WORDS)])  # where each begins in the code of an instruction, and finally its length

AT_ONCE = 2  # most instructions joined by "and", on either side of "then"
REMEMBERED = 1 << 12  # size of the caches of codes and of things, which every step looks up for its mission

_A_THING = rf"(?:a|the) (?:({'|'.join(COLOURS)}) )?({'|'.join(KINDS)})(?: ({'|'.join(PLACES)}))?"
_INSTRUCTION = re.compile(rf"({'|'.join(VERBS)}) {_A_THING}(?: next to {_A_THING})?")

Vector = npt.NDArray[np.uint8]


class Instructions:
    """The missions of BabyAI (Chevalier-Boisvert et al. 2019, §3.2), of one to four instructions.

    A code holds the one-hot words of each instruction in the order of execution: "go to the ball after you open a
    door" has the code of "open a door, then go to the ball". Articles are left out.
    """

    n_words = 2 * AT_ONCE * int(BEGINS[-1])  # length of a code
    n_things = 2  # that of the first instruction, and the thing to put it next to

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def code(text: str) -> Vector | None:
        """Return the code of a mission, (`n_words`,); None if it is not one of BabyAI's."""
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
        code.setflags(write=False)  # the cache returns it again
        return code.ravel()

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def things_in(code: bytes) -> bytes:
        """Return the things that the first instruction of a code names by colour, for `things_of`."""
        first = np.frombuffer(code, np.uint8)[: BEGINS[-1]]
        colours, kinds = ([_word(first, i) for i in of] for of in ((1, 4), (2, 5)))
        objects = [*KINDS.values(), 0]
        return bytes_of(
            [(objects[kind], colour) if colour >= 0 else NO_THING for colour, kind in zip(colours, kinds, strict=True)]
        )


def _word(instruction: Vector, i: int) -> int:
    """Return which word of `WORDS[i]` an instruction has; -1 for none."""
    chosen = instruction[BEGINS[i] : BEGINS[i + 1]]
    return int(chosen.argmax()) if chosen.any() else -1
