"""Places that were candidates often enough."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from sb3_options.density.arrays import row_keys
from sb3_options.density.regions import Region
from sb3_options.discovery.methods.method import Experience, Method
from sb3_options.experience.observations import FloatArray, IntArray

MAX_PLACES = 20_000  # later ones are not counted
MAX_NUMBERS = 8_000_000  # features of all places (64 MB)
PLACE_SECONDS = 2e-7  # nominal time of an update, per remembered place


class CandidateMethod(Method):
    """A method whose subgoals are the places that were candidates often enough.

    It counts for every place how often it was seen and how often it was a candidate.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_row", "_points", "_counts")

    def __init__(self) -> None:
        self._row: dict[bytes, int] = {}  # row of each place, by its bin
        self._points: FloatArray = np.zeros(0)  # (n, d) once there is a place
        self._counts: FloatArray = np.zeros((0, 3))  # times seen, times candidate, and whether it may be a subgoal

    @abstractmethod
    def _accepted(self, seen: FloatArray, hits: FloatArray) -> FloatArray:
        """Score places by how often they were seen and were candidates, (n,). A positive score accepts a place."""

    def _counted(self, experience: Experience, seen: IntArray, hits: IntArray) -> list[Region]:
        """Add a trajectory's counts of its places, and return the accepted places, best first.

        Only places that may be subgoals are proposed.
        """
        places = experience.places
        those = np.flatnonzero(seen)
        room = max(min(MAX_PLACES, MAX_NUMBERS // places.points.shape[1]), 1)
        keys = row_keys(places.bins[those])
        new = [i for i, key in enumerate(keys) if key not in self._row][: room - len(self._row)]
        if new:
            self._row |= {keys[i]: len(self._row) + n for n, i in enumerate(new)}
            points = places.points[those[new]]
            self._points = np.concatenate([self._points.reshape(-1, points.shape[1]), points])
            self._counts = np.concatenate([self._counts, np.zeros((len(new), 3))])
        counted = those[[key in self._row for key in keys]]
        rows = [self._row[key] for key in keys if key in self._row]
        self._counts[rows, 0] += seen[counted]
        self._counts[rows, 1] += hits[counted]
        self._counts[rows, 2] = places.allowed[counted]
        possible = np.flatnonzero(self._counts[:, 2])
        if not len(possible):
            return []
        accepted = self._accepted(*self._counts[possible, :2].T)
        order = np.argsort(-accepted, kind="stable")
        return [experience.region(self._points[possible[i]]) for i in order if accepted[i] > 0]

    def seconds(self, experience: Experience) -> float:
        """Return the nominal time of an update."""
        return PLACE_SECONDS * len(self._row)
