"""Whether the runs of options get there, and from where: elsewhere they are offered no longer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations, batch_size, concatenate
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options.option import SubgoalOption

MIN_RUNS = 50
"""Fewer runs than this close no option."""

WINDOW = 100
"""No more than so many last runs of a slot count."""

RUNS_BETWEEN = 25
"""Runs of a slot between two judgements."""

MIN_PASSES = 8
"""Runs that passed a state of I before it can be taken out."""

DECIDED = ("subgoal", "left_initiation", "max_duration")
"""Endings that neither the end of an episode nor a better choice brought about."""


class Reliability:
    """Takes states out of an initiation set from where runs do not arrive, and says when an option is to be closed.

    I is learned from saved trajectories; how runs end says where the option works (Konidaris & Barto 2009, §3). I loses
    a state when too few of the runs that passed it reached the subgoal: they left I, or went on until `max_duration`,
    because on what it sees the policy goes in a circle there. An option is closed when too many of its last runs went
    in a circle and no state is to blame, or every one is.

    Runs that left I close no option: they cost little, and who chooses can do something else there. A policy that has
    learned to use an option loses more by its end than by such runs.

    Args:
        least: Share of the runs that have to reach the subgoal from a state, and to end before `max_duration`, in
            [0, 1]; 0 keeps no runs and never judges.
    """

    def __init__(self, least: float) -> None:
        self.least = least
        self._new: dict[int, deque[tuple[Observations, Termination]]] = {}  # since the last judgement
        self._judged: dict[int, deque[tuple[FloatArray, Termination]]] = {}  # of those before what I sees alone
        self._failed: dict[int, tuple[FloatArray, IntArray]] = {}  # centres that I lost, and what π did there

    def add(self, run: OptionRun) -> None:
        """Note a run that began in the initiation set."""
        if self.least and run.termination in DECIDED:
            assert run.observations is not None  # it is that of an option
            self._new.setdefault(run.index, deque(maxlen=WINDOW)).append((run.observations, run.termination))

    def forget(self, slot: int) -> None:
        """Forget an option that is closed."""
        self.forget_runs(slot)
        self._failed.pop(slot, None)

    def forget_runs(self, slot: int) -> None:
        """Forget the runs of an option that has become another."""
        self._new.pop(slot, None)
        self._judged.pop(slot, None)

    def forget_places(self) -> None:
        """Forget which states initiation sets lost, and those that runs passed: φ has become another."""
        self._failed.clear()
        self._judged.clear()

    def learned_anew(self, slot: int, later: SubgoalOption) -> SubgoalOption | None:
        """An option that was learned anew, without the states that I has lost, where π does what it did.

        Where π does something else now, it may arrive. What is not known to be the same, as where π acts on
        observations, is taken to be.

        Args:
            slot: Of the option.
            later: As it was learned from saved trajectories, which do not tell how runs end.

        Returns:
            The option, whose runs count from now on; None if I has no other state.
        """
        if slot in self._failed:
            region, (failed, did) = later.initiation_set, self._failed[slot]
            does = later.option_policy.actions(failed) if later.policy_input == "features" else did
            failed = failed[does == did]
            kept = ~(region.points[:, None] == failed[None]).all(axis=2).any(axis=1)
            if not kept.any():
                return None
            later = later.with_regions(later.subgoal, replace(region, points=region.points[kept]))
        self.forget_runs(slot)
        return later

    def ended(self, slot: int) -> float | None:
        """Share of a slot's last runs that ended before `max_duration`; None if they are fewer than `MIN_RUNS`."""
        ends = [why for _, why in (*self._judged.get(slot, ()), *self._new.get(slot, ()))][-WINDOW:]
        return float(np.mean([why != "max_duration" for why in ends])) if len(ends) >= MIN_RUNS else None

    def judged(self, options: OptionInstaller) -> Iterator[tuple[int, SubgoalOption | None]]:
        """What becomes of options after their last runs.

        Args:
            options: Those that are installed, and φ.

        Yields:
            A slot, and its option with a smaller initiation set, whose runs count from now on; or None: it is to be
            closed.
        """
        due = [slot for slot in options.installed() if len(self._new.get(slot, ())) >= RUNS_BETWEEN]
        for slot, option in [(slot, options.bank[slot]) for slot in due]:
            new = self._new.pop(slot)
            if not (isinstance(option, SubgoalOption) and len(option.subgoal.points)):
                continue
            self._note_passed(slot, option, new, options.features_of)
            failing = self._failing(slot, option)
            ended = self.ended(slot)
            if failing.any() and not failing.all():
                region = option.initiation_set
                self._note(slot, option, region.points[failing])
                self.forget_runs(slot)
                yield slot, option.with_regions(option.subgoal, replace(region, points=region.points[~failing]))
            elif ended is not None and ended < self.least:
                yield slot, None

    def _note(self, slot: int, option: SubgoalOption, failed: FloatArray) -> None:
        """Remember which centres an initiation set loses."""
        of_features = option.policy_input == "features"
        did = option.option_policy.actions(failed) if of_features else np.zeros(len(failed), dtype=np.int64)
        if slot in self._failed:
            before, then = self._failed[slot]
            failed, did = np.concatenate([before, failed]), np.concatenate([then, did])
        self._failed[slot] = failed, did

    def _note_passed(
        self,
        slot: int,
        option: SubgoalOption,
        runs: Iterable[tuple[Observations, Termination]],
        features_of: Callable[[Observations], FloatArray],
    ) -> None:
        """Keep what the initiation set sees of the states that runs passed, for observations may be pictures."""
        observations, ends = zip(*runs, strict=True)
        features = option.initiation_set.own(features_of(concatenate(list(observations))))
        parts = np.split(features, np.cumsum([batch_size(each) for each in observations[:-1]]))
        self._judged.setdefault(slot, deque(maxlen=WINDOW)).extend(zip(parts, ends, strict=True))

    def _failing(self, slot: int, option: SubgoalOption) -> BoolArray:
        """Which centres of I are nearest to states from where too few runs arrive, shape (n,)."""
        runs, region = self._judged[slot], option.initiation_set
        if not len(region.points):
            return np.zeros(0, dtype=bool)
        features = np.concatenate([passed for passed, _ in runs])
        nearest = cdist(features * region.scale, region.points * region.scale).argmin(axis=1)
        durations = [len(passed) for passed, _ in runs]
        passed: BoolArray = np.zeros((len(runs), len(region.points)), dtype=bool)
        passed[np.repeat(np.arange(len(runs)), durations), nearest] = True
        passes = passed.sum(axis=0)
        reached = passed[[why == "subgoal" for _, why in runs]].sum(axis=0)
        failing: BoolArray = (passes >= MIN_PASSES) & (reached < self.least * passes)
        return failing

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        new = {slot: list(runs) for slot, runs in self._new.items()}
        judged = {slot: list(runs) for slot, runs in self._judged.items()}
        return {"runs": new, "judged": judged, "failed": dict(self._failed)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._new, self._judged = (
            {slot: deque(map(tuple, runs), maxlen=WINDOW) for slot, runs in of.items()}
            for of in (state["runs"], state.get("judged", {}))  # checkpoints of before have the observations of all
        )
        self._failed = {slot: tuple(failed) for slot, failed in state["failed"].items()}
