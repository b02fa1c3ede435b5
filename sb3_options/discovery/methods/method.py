"""What a method of discovery is told, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from sb3_options.checked import is_number
from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.proposals import IntrinsicReward, Passage, Proposal, bins_of, everywhere

__all__ = ["DiscoveryMethod", "Experience", "IntrinsicReward", "Passage", "Places", "Proposal", "Region"]


PROPOSALS = (Region, Passage, IntrinsicReward)
"""What an option may be made for."""

Array = TypeVar("Array", bound=npt.NDArray[Any])
Placed = TypeVar("Placed", bound=Region | IntrinsicReward)

SIGN = np.int64(-(1 << 63))
"""The bit of the sign."""


class Experience:
    """One trajectory, as methods see it.

    Args:
        features: φ of its distinct observations, in order of first visit, (m, d); methods may not write to it.
        visits: Row of ``features`` at every time t = 0 … T, (T + 1,); likewise.
        success: Whether it was successful.
        allowed: Which of its states may be subgoals, (m,): the static filter allows them, and no subgoal is near.
        scale: Factor for every feature that makes one unit one step, (d,).
        radius: Of a subgoal, in scaled units.
        taken: Subgoals that there are options for.
        trajectory: Itself, with actions, rewards and observations; may be left out.
    """

    def __init__(
        self,
        features: FloatArray,
        visits: IntArray,
        *,
        success: bool,
        allowed: BoolArray,
        scale: FloatArray,
        radius: float,
        taken: Sequence[Region] = (),
        trajectory: Trajectory | None = None,
    ) -> None:
        self.features, self.visits, self.success = _read_only(features), _read_only(visits), success
        self.allowed, self.scale, self.radius, self.taken = allowed, scale, radius, tuple(taken)
        self._trajectory = trajectory

    @cached_property
    def trajectory(self) -> Trajectory:
        """Itself: ``actions`` and ``rewards`` of every step, and the observation behind each row of ``features``.

        Raises:
            AttributeError: It was made without.
        """
        known = self._trajectory
        if known is None:
            raise AttributeError("this experience was made of features and visits alone: it has no trajectory.")
        states = known.states
        return replace(
            known,
            states={key: _read_only(of) for key, of in states.items()}
            if isinstance(states, Mapping)
            else _read_only(np.asarray(states)),
            visits=self.visits,
            actions=_read_only(known.actions),
            rewards=_read_only(known.rewards),
        )

    @cached_property
    def places(self) -> Places:
        """Its states, binned at one unit of concept space, so that states that differ by less are one."""
        bins = bins_of(self.features, self.scale)
        first, which = distinct_rows(bins)
        allowed = np.ones(len(first), dtype=bool)
        allowed[which[~self.allowed]] = False
        return Places(self.features[first], bins[first], which[self.visits], allowed)

    def region(self, point: ArrayLike) -> Region:
        """The region around a place, (d,)."""
        return Region(np.array(point, dtype=np.float64)[None], self.scale, self.radius)

    @property
    def everywhere(self) -> Region:
        """The region of all states: a `Passage` from there starts wherever saved steps lead to its subgoal."""
        return everywhere(len(self.scale))


def _read_only(array: Array) -> Array:
    """The same numbers, which the database holds, too."""
    seen = array.view()
    seen.flags.writeable = False
    return seen


def distinct_rows(rows: FloatArray) -> tuple[IntArray, IntArray]:
    """Numbers of the first of each of the distinct rows (m, d), in order of their values, (k,), and which each row is.

    As ``np.unique(axis=0)`` has it, which takes ten times as long: it makes a field of a structure of each column.
    """
    differ = (rows != rows[:1]).any(axis=0)  # the other columns, as most of one-hot codes, change nothing
    rows = rows[:, differ] if differ.any() else rows[:, :1]
    bits = np.ascontiguousarray(rows + 0.0).view(np.int64)  # -0.0 is 0.0
    # Of negative numbers the larger ones have the smaller bits; and those of the smallest row are to come first.
    ordered = np.where(bits < 0, ~bits, bits ^ SIGN).astype(">i8")
    keys = ordered.view(f"V{8 * rows.shape[1]}").ravel().tolist()
    first: dict[bytes, int] = {}
    for row, key in enumerate(keys):
        first.setdefault(key, row)
    in_order = sorted(first)
    number = {key: i for i, key in enumerate(in_order)}
    return np.array([first[key] for key in in_order]), np.array([number[key] for key in keys])


class Places(NamedTuple):
    """The distinct places of a trajectory.

    Attributes:
        points: One state of each, (k, d).
        bins: Which place it is, whole numbers, (k, d).
        visits: Row of ``points`` at every time, (T + 1,).
        allowed: Whether all its states may be subgoals, (k,).
    """

    points: FloatArray
    bins: FloatArray
    visits: IntArray
    allowed: BoolArray


class DiscoveryMethod(Protocol):
    """Proposes subgoals from what the agent lived through, and from nothing else.

    Any object with this method may be passed as ``SubgoalDiscoveryCallback(method=…)``. A checkpoint also needs
    ``get_state()``, which gives a dictionary of arrays and plain values, and ``set_state(state)``. The `Budget` also
    needs ``seconds(experience)``: how long an update takes, estimated by sizes and not by the clock. Without it what
    updates take is measured, so that two trainings with one seed may be told of different trajectories.
    ``needs_success = True`` says that a method proposes nothing
    before a success, and users are told so where there is none.
    """

    def update(self, experience: Experience) -> Sequence[Proposal]:
        """Take note of one more trajectory.

        Args:
            experience: The trajectory.

        Returns:
            Regions to reach, passages, or intrinsic rewards to make options for, best first. The first that
            leads far enough from other subgoals is taken. What is proposed again after the next trajectory is
            considered again.
        """
        ...


def checked_method(method: Any) -> DiscoveryMethod | None:
    """A user's own method; None for a name, or for nothing.

    Raises:
        TypeError: It is none: a class, say, or without ``update``.
    """
    if method is None or isinstance(method, str):
        return None
    container = isinstance(method, (Mapping, Set))  # which have an update of their own
    if container or isinstance(method, type) or not callable(getattr(method, "update", None)):
        what = f"the class {method.__name__}, which is not made yet" if isinstance(method, type) else repr(method)
        raise TypeError(f"method must be a name, or an object with update(experience), got {what}.")
    made: DiscoveryMethod = method
    return made


def proposed_by(method: DiscoveryMethod, experience: Experience) -> list[Proposal]:
    """What a method proposes after one more trajectory.

    Raises:
        TypeError: It answers something else.
        ValueError: A proposal has arrays of other shapes, or numbers that are not finite.
        RuntimeError: A user's own raised a ValueError, which would pass for an episode that cannot be used.
    """
    try:
        proposals = method.update(experience)
    except ValueError as error:
        if _is_of_the_library(method):
            raise
        raise RuntimeError(f"{type(method).__name__}.update failed: {error}") from error
    if not isinstance(proposals, Sequence) or not all(isinstance(each, PROPOSALS) for each in proposals):
        names = ", ".join(kind.__name__ for kind in PROPOSALS)
        raise TypeError(f"{type(method).__name__}.update must return a list of {names}, got {proposals!r:.200}.")
    name, size = type(method).__name__, experience.features.shape[1]
    for each in proposals:
        for region in _regions_of(each):
            points, scale = np.shape(region.points), np.shape(region.scale)
            if (len(points), *points[1:], *scale) != (2, size, size) or not points[0]:
                raise ValueError(
                    f"{name} proposed a {type(each).__name__} whose points have shape {points} and whose scale has "
                    f"{scale}; they must be (n, {size}) and ({size},), n ≥ 1, for φ has {size} features."
                )
    return list(proposals)


def kept(proposal: Proposal, method: DiscoveryMethod) -> Proposal:
    """A proposal that is taken, of arrays that the method cannot change later on.

    Args:
        proposal: As `proposed_by` gave it.
        method: Whose it is.

    Raises:
        ValueError: It has numbers that are not finite, or a radius below 0.
    """
    for region in _regions_of(proposal):
        if not (np.isfinite(region.points).all() and np.isfinite(region.scale).all() and 0 <= region.radius < np.inf):
            raise ValueError(
                f"{type(method).__name__} proposed a {type(proposal).__name__} with points, scale or radius that are "
                "not finite, or a radius below 0."
            )
    if isinstance(proposal, Passage):
        return Passage(_copied(proposal.subgoal), _copied(proposal.initiation))
    return _copied(proposal)


def _is_of_the_library(method: DiscoveryMethod) -> bool:
    """Whether a method is no user's own."""
    return type(method).__module__.startswith("sb3_options.")


def _copied(region: Placed) -> Placed:
    """The same with arrays of its own."""
    points, scale = np.array(region.points, dtype=np.float64), np.array(region.scale, dtype=np.float64)
    return replace(region, points=points, scale=scale)


def _regions_of(proposal: Proposal) -> tuple[Region | IntrinsicReward, ...]:
    """What has points in concept space."""
    if isinstance(proposal, Passage):
        return proposal.subgoal, proposal.initiation
    return (proposal,)


def seconds_by(method: DiscoveryMethod, experience: Experience) -> float | None:
    """Nominal time of an update, as the method has it; 0 of one of the library's, and None of another, that says none.

    Raises:
        ValueError: It is no finite number of at least 0.
    """
    if not hasattr(method, "seconds"):
        return 0.0 if _is_of_the_library(method) else None
    seconds = method.seconds(experience)
    if not (is_number(seconds) and 0.0 <= seconds < np.inf):
        raise ValueError(
            f"{type(method).__name__}.seconds must return a finite number of at least 0, got {seconds!r:.200}."
        )
    return float(seconds)
