"""Whether an option is of use: how its runs end, whether episodes with it succeed, and whether successes need it.

An option on a few features may work from some states and not from others that look the same. How its runs end tells
where it works (Konidaris & Barto 2009, §3). So a state from where too few runs arrive leaves the initiation set, and
an option is closed where no state is to blame and its last runs say so (`verdict`). Options that are closed, or that
hardly any success passes while others wait for a slot, make room for new ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import bdtr

from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.density.regions import Region
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray, Observations, batch_size, concatenate
from sb3_options.experience.option_run import OptionRun
from sb3_options.options.option import SubgoalOption
from sb3_options.options.settings import UsefulnessSettings
from sb3_options.state import TRANSIENT, storable

Ending: TypeAlias = Literal["subgoal", "left_initiation", "max_duration", "failed"]
"""How a run ends that neither a better choice nor a time limit cut off; ``failed`` ends the episode without success."""

Verdict: TypeAlias = Literal["does not arrive", "goes in circles", "ends in failure", "is not needed"]

MIN_RUNS = 50  # fewer runs than this close no option
WINDOW = 100  # last runs of a slot, and last episodes, that count
RUNS_BETWEEN = 25  # runs of a slot between two judgements
MIN_PASSES = 8  # runs that passed a state of I before it can be taken out

NEVER = 0.2
"""An option does not arrive if fewer of its runs do than this share of `min_reached`. To close those that arrive more
often and leave I did harm (docs/studies/minigrid.md, six large rooms)."""

ALPHA = 0.01
"""Level of each test: the probability that one judgement takes away what only just does as it should."""

MIN_SUCCESSES = 20  # successes that an option was there for before it can be found not needed

NEEDED = 0.1
"""Share of successes that pass the subgoal of an option that is needed."""


@storable
class Episode(NamedTuple):
    """Whether an option ran in an episode, and whether that succeeded."""

    ran: bool
    success: bool


def verdict(endings: Sequence[Ending], episodes: Iterable[Episode], min_reached: float) -> Verdict | None:
    """Why an option is to be closed, from its last runs and episodes; None if it stays.

    An option whose runs go in circles until `max_duration` is closed. One that hardly ever arrives, or that mostly ends
    episodes in failure, stays if episodes with it succeed more often than those without it: in a hard task most runs of
    primitive actions fail, too.
    """
    n = len(endings)
    if n < MIN_RUNS:
        return None
    if fewer(n - endings.count("max_duration"), n, min_reached):
        return "goes in circles"
    if fewer(n - endings.count("failed"), n, min_reached):
        return None if helps(episodes) else "ends in failure"
    if fewer(endings.count("subgoal"), n, NEVER * min_reached):
        return None if helps(episodes) else "does not arrive"
    return None


def fewer(k: IntArray | int, n: IntArray | int, share: float) -> Any:
    """Whether k of n are fewer than a share, by a one-sided binomial test at `ALPHA`."""
    return bdtr(k, n, share) < ALPHA


def helps(episodes: Iterable[Episode]) -> bool:
    """Whether episodes in which an option ran succeed more often than the others, by Fisher's exact test at `ALPHA`."""
    from scipy.stats import hypergeom  # here, because it takes more than a second to import

    ran, success = np.array(list(episodes), dtype=bool).reshape(-1, 2).T
    return bool(hypergeom.sf((ran & success).sum() - 1, len(ran), success.sum(), ran.sum()) < ALPHA)


@storable
@dataclass
class SlotRecord:
    """What is known of the option in one slot, since it is there or became another."""

    # Runs since the last judgement with the observations that they passed, runs before with what I sees of those, the
    # last episodes, and whether each of the last successes passed the subgoal.
    new: deque[tuple[Observations, Ending]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    judged: deque[tuple[FloatArray, Ending]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    last: deque[Ending] = field(default_factory=lambda: deque(maxlen=WINDOW))
    episodes: deque[Episode] = field(default_factory=lambda: deque(maxlen=WINDOW))
    needed: deque[bool] = field(default_factory=lambda: deque(maxlen=WINDOW))

    @property
    def endings(self) -> list[Ending]:
        """Of the last runs."""
        return [why for _, why in (*self.judged, *self.new)][-WINDOW:]


@dataclass(eq=False)
class Usefulness:
    """Judges the options of all slots while an agent learns."""

    settings: UsefulnessSettings = field(metadata=TRANSIENT)
    _slots: dict[int, SlotRecord] = field(default_factory=dict, init=False)
    _ran: dict[int, set[int]] = field(default_factory=dict, init=False)  # by environment, the slots of its episode
    _failed: dict[int, tuple[FloatArray, IntArray]] = field(default_factory=dict, init=False)  # lost states, π there

    def add(self, run: OptionRun, env: int, *, success: bool | None) -> None:
        """Note a run that began in I, in which environment, and the success of the episode that it ended, if any."""
        if self.settings.min_reached == 0:
            return
        self._ran.setdefault(env, set()).add(run.index)
        ending = "failed" if run.termination == "terminated" and success is False else run.termination
        if ending in ("subgoal", "left_initiation", "max_duration", "failed"):
            assert run.observations is not None  # it is that of an option
            self._of(run.index).new.append((run.observations, ending))
            self._of(run.index).last.append(ending)

    def episode_ended(self, env: int, filled: Iterable[int], *, success: bool) -> None:
        """Note which options ran in an episode."""
        ran = self._ran.pop(env, set())
        for slot in filled if self.settings.min_reached > 0 else ():
            self._of(slot).episodes.append(Episode(slot in ran, success))

    def counts_needs(self, options: OptionInstaller) -> bool:
        """Whether it is still to be seen which subgoals successes pass."""
        return self.settings.min_reached > 0 and any(
            len(self._of(slot).needed) < WINDOW for slot, _ in _judged(options)
        )

    def succeeded(self, options: OptionInstaller, features: FloatArray) -> None:
        """Note which subgoals a success passed, from φ of its states, (m, d)."""
        for slot, option in _judged(options):
            self._of(slot).needed.append(bool(option.subgoal.contains(features).any()))

    def unneeded(self, options: OptionInstaller) -> int | None:
        """The slot whose subgoal fewest successes pass, if these are fewer than `NEEDED`."""
        records = {slot: self._of(slot).needed for slot, _ in _judged(options)}
        shares = {slot: float(np.mean(of)) for slot, of in records.items() if len(of) >= MIN_SUCCESSES}
        weakest = min(shares, key=shares.__getitem__, default=None)
        return weakest if weakest is not None and shares[weakest] < NEEDED else None

    def judged(self, options: OptionInstaller) -> Iterator[tuple[int, SubgoalOption | Verdict]]:
        """Yield slots whose option loses states of I, with what it is without them, or is to be closed, and why."""
        for slot, option in _judged(options):
            record = self._of(slot)
            if len(record.new) < RUNS_BETWEEN:
                continue
            self._see(record, option, options.features_of)
            sure, likely = self._failing(record, option)
            whole = (
                verdict(record.last, record.episodes, self.settings.min_reached) if len(record.last) == WINDOW else None
            )
            why = verdict(record.endings, record.episodes, self.settings.min_reached)
            lost = sure if why is not None else sure | likely
            if whole == "does not arrive":  # and it is no use to lose more states
                yield slot, whole
            elif lost.any() and not lost.all():
                region = option.initiation_set
                self._remember(slot, option, region.points[lost])
                self.forget_runs(slot)
                yield slot, option.with_regions(option.subgoal, replace(region, points=region.points[~lost]))
            elif why is not None:
                yield slot, why
            elif likely.any() and not helps(record.episodes):  # from nowhere it arrives often enough
                yield slot, "does not arrive"

    def learned_anew(self, slot: int, later: SubgoalOption) -> SubgoalOption | None:
        """An option that was learned anew, without the states that I has lost, unless π does something else there.

        Where π acts on observations, it is taken to do the same. None if I has no other state.
        """
        if slot in self._failed:
            region = later.initiation_set
            failed, did = self._failed[slot]
            does = later.option_policy.actions(failed) if later.policy_input == "features" else did
            failed = failed[does == did]
            kept = ~(region.points[:, None] == failed[None]).all(axis=2).any(axis=1)
            if not kept.any():
                return None
            later = later.with_regions(later.subgoal, replace(region, points=region.points[kept]))
        self.forget_runs(slot)
        return later

    def forget(self, slot: int) -> None:
        """Forget an option that is closed."""
        self._slots.pop(slot, None)
        self._failed.pop(slot, None)

    def forget_runs(self, slot: int) -> None:
        """Forget the runs of an option that has become another."""
        self._of(slot).new.clear()
        self._of(slot).judged.clear()

    def forget_places(self) -> None:
        """Forget states that initiation sets lost and that runs passed: φ has become another."""
        self._failed.clear()
        for record in self._slots.values():
            record.judged.clear()

    def _of(self, slot: int) -> SlotRecord:
        return self._slots.setdefault(slot, SlotRecord())

    def _remember(self, slot: int, option: SubgoalOption, lost: FloatArray) -> None:
        """Remember states that an initiation set loses, and what π does there."""
        of_features = option.policy_input == "features"
        does = option.option_policy.actions(lost) if of_features else np.zeros(len(lost), dtype=np.int64)
        before, did = self._failed.get(slot, (lost[:0], does[:0]))
        self._failed[slot] = np.concatenate([before, lost]), np.concatenate([did, does])

    def _see(
        self, record: SlotRecord, option: SubgoalOption, features_of: Callable[[Observations], FloatArray]
    ) -> None:
        """Keep of new runs what the initiation set sees: observations may be pictures."""
        observations, endings = zip(*record.new, strict=True)
        features = option.initiation_set.own(features_of(concatenate(list(observations))))
        parts = np.split(features, np.cumsum([batch_size(each) for each in observations[:-1]]))
        record.judged.extend(zip(parts, endings, strict=True))
        record.new.clear()

    def _failing(self, record: SlotRecord, option: SubgoalOption) -> tuple[BoolArray, BoolArray]:
        """Centres of I nearest to states from where too few runs arrive, (n,): surely; by the share, if all surely do.

        Failures of an option may be spread over many states, too few at each to be sure.
        """
        region: Region = option.initiation_set
        if not len(region.points):
            return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
        features = np.concatenate([states for states, _ in record.judged])
        nearest = cdist(features * region.scale, region.points * region.scale).argmin(axis=1)
        runs = np.repeat(np.arange(len(record.judged)), [len(states) for states, _ in record.judged])
        passed: BoolArray = np.zeros((len(record.judged), len(region.points)), dtype=bool)
        passed[runs, nearest] = True
        arrived = np.array([why == "subgoal" for _, why in record.judged])
        passes = passed.sum(axis=0)
        arrivals = passed[arrived].sum(axis=0)
        least = self.settings.min_reached
        enough: BoolArray = passes >= MIN_PASSES
        seldom = len(arrived) >= MIN_RUNS and fewer(arrived.sum(), len(arrived), least)
        return enough & fewer(arrivals, passes, least), enough & seldom & (arrivals < least * passes)


def _judged(options: OptionInstaller) -> list[tuple[int, SubgoalOption]]:
    """The options that lead somewhere: a hand-made one does not say where to."""
    filled = [(slot, options.bank[slot]) for slot in options.installed()]
    return [(slot, each) for slot, each in filled if isinstance(each, SubgoalOption) and len(each.subgoal.points)]
