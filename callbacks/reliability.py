"""Whether the runs of options get there, and from where: elsewhere they are offered no longer."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
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
        self._runs: dict[int, deque[tuple[Observations, Termination]]] = {}
        self._since: Counter[int] = Counter()
        self._failed: dict[int, tuple[FloatArray, IntArray]] = {}  # centres that I lost, and what π did there

    def add(self, run: OptionRun) -> None:
        """Note a run that began in the initiation set."""
        if self.least and run.termination in DECIDED:
            assert run.observations is not None  # it is that of an option
            runs = self._runs.setdefault(run.index, deque(maxlen=WINDOW))
            runs.append((run.observations, run.termination))
            self._since[run.index] += 1

    def forget(self, slot: int) -> None:
        """Forget an option that is closed."""
        self.forget_runs(slot)
        self._failed.pop(slot, None)

    def forget_runs(self, slot: int) -> None:
        """Forget the runs of an option that has become another."""
        self._runs.pop(slot, None)
        self._since.pop(slot, None)

    def forget_places(self) -> None:
        """Forget which states initiation sets lost: φ has become another."""
        self._failed.clear()

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
        runs = self._runs.get(slot, ())
        return float(np.mean([why != "max_duration" for _, why in runs])) if len(runs) >= MIN_RUNS else None

    def judged(self, options: OptionInstaller) -> Iterator[tuple[int, SubgoalOption | None]]:
        """What becomes of options after their last runs.

        Args:
            options: Those that are installed, and φ.

        Yields:
            A slot, and its option with a smaller initiation set, whose runs count from now on; or None: it is to be
            closed.
        """
        due = [slot for slot in options.installed() if self._since[slot] >= RUNS_BETWEEN]
        for slot, option in [(slot, options.bank[slot]) for slot in due]:
            self._since[slot] = 0
            if not (isinstance(option, SubgoalOption) and len(option.subgoal.points)):
                continue
            failing = self._failing(slot, option, options.features_of)
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

    def _failing(
        self, slot: int, option: SubgoalOption, features_of: Callable[[Observations], FloatArray]
    ) -> BoolArray:
        """Which centres of I are nearest to states from where too few runs arrive, shape (n,)."""
        runs, region = self._runs[slot], option.initiation_set
        if not len(region.points):
            return np.zeros(0, dtype=bool)
        features = region.own(features_of(concatenate([observations for observations, _ in runs])))
        nearest = cdist(features * region.scale, region.points * region.scale).argmin(axis=1)
        durations = [batch_size(observations) for observations, _ in runs]
        passed: BoolArray = np.zeros((len(runs), len(region.points)), dtype=bool)
        passed[np.repeat(np.arange(len(runs)), durations), nearest] = True
        passes = passed.sum(axis=0)
        reached = passed[[why == "subgoal" for _, why in runs]].sum(axis=0)
        failing: BoolArray = (passes >= MIN_PASSES) & (reached < self.least * passes)
        return failing

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint."""
        runs = {slot: list(runs) for slot, runs in self._runs.items()}
        return {"runs": runs, "since": dict(self._since), "failed": dict(self._failed)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with what `get_state` gave."""
        self._runs = {slot: deque(map(tuple, runs), maxlen=WINDOW) for slot, runs in state["runs"].items()}
        self._since = Counter(state["since"])
        self._failed = {slot: tuple(failed) for slot, failed in state["failed"].items()}
