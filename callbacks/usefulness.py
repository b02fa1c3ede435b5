"""Judges options by how their runs end, whether their episodes succeed, and whether successes need them.

An option on a few features may work from some states and not from others that look the same. How its runs end tells
where it works (Konidaris & Barto 2009, §3). A state from which too few runs arrive leaves the initiation set. If no
state is to blame, the option's last runs may close it (`verdict`). If options wait for a slot, an option that hardly
any success passes makes room for a new one.
"""

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
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
"""How a run ends that no better choice or time limit cut off; ``failed`` ends the episode without success."""

Verdict: TypeAlias = Literal["does not arrive", "goes in circles", "ends in failure", "is not needed"]

MIN_RUNS = 50  # fewer runs than this close no option
WINDOW = 100  # number of last runs of a slot, and of last episodes, that count
RUNS_BETWEEN = 25  # runs of a slot between two judgements
MIN_PASSES = 8  # runs that must pass a state of I before it can be removed

NEVER = 0.2
"""An option does not arrive if fewer of its runs do than this share of `min_reached`. Closing options that arrive more
often and leave I did harm (docs/studies/minigrid.md, six large rooms)."""

ALPHA = 0.01
"""Level of each test: the probability that one judgement rejects an option or state that is just good enough."""

MIN_SUCCESSES = 20  # successes with an option in its slot before it can be found not needed

NEEDED = 0.1
"""Least share of successes that pass the subgoal of a needed option."""


@storable
class Episode(NamedTuple):
    """Whether an option ran in an episode, and whether the episode succeeded."""

    ran: bool
    success: bool


def verdict(endings: Sequence[Ending], episodes: Iterable[Episode], min_reached: float) -> Verdict | None:
    """Return why an option is to be closed, by its last runs and episodes, or None if it stays.

    An option whose runs go in circles until `max_duration` is closed. One that hardly ever arrives, or mostly ends
    episodes in failure, stays if episodes with it succeed more often than those without it. In a hard task most runs of
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
    """Return whether k of n are fewer than a share, by a one-sided binomial test at `ALPHA`."""
    return bdtr(k, n, share) < ALPHA


def helps(episodes: Iterable[Episode]) -> bool:
    """Return whether episodes with an option succeed more often than others, by Fisher's exact test at `ALPHA`."""
    from scipy.stats import hypergeom  # here, because it takes more than a second to import

    ran, success = np.array(list(episodes), dtype=bool).reshape(-1, 2).T
    return bool(hypergeom.sf((ran & success).sum() - 1, len(ran), success.sum(), ran.sum()) < ALPHA)


@storable
@dataclass
class SlotRecord:
    """Record of the option in one slot, since it was installed or last changed."""

    # Runs since the last judgement with their observations; earlier runs with the features that I sees; how runs ended;
    # the last episodes; whether each of the last successes passed the subgoal.
    new: deque[tuple[Observations, Ending]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    judged: deque[tuple[FloatArray, Ending]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    last: deque[Ending] = field(default_factory=lambda: deque(maxlen=WINDOW))
    episodes: deque[Episode] = field(default_factory=lambda: deque(maxlen=WINDOW))
    needed: deque[bool] = field(default_factory=lambda: deque(maxlen=WINDOW))

    @property
    def endings(self) -> list[Ending]:
        """How the last runs ended."""
        return [why for _, why in (*self.judged, *self.new)][-WINDOW:]


@dataclass(eq=False)
class Usefulness:
    """Judges the options of all slots while an agent learns."""

    settings: UsefulnessSettings = field(metadata=TRANSIENT)
    _slots: dict[int, SlotRecord] = field(default_factory=lambda: defaultdict(SlotRecord), init=False)
    _ran: dict[int, set[int]] = field(default_factory=dict, init=False)  # by environment: slots of its episode
    _failed: dict[int, tuple[FloatArray, IntArray]] = field(default_factory=dict, init=False)  # lost states, π there

    def add(self, run: OptionRun, env: int, *, success: bool | None) -> None:
        """Record a run that began in I, its environment, and the success of the episode that it ended, if any."""
        if self.settings.min_reached == 0:
            return
        self._ran.setdefault(env, set()).add(run.index)
        ending = "failed" if run.termination == "terminated" and success is False else run.termination
        if ending in ("subgoal", "left_initiation", "max_duration", "failed"):
            assert run.observations is not None  # the run is of an option
            self._slots[run.index].new.append((run.observations, ending))
            self._slots[run.index].last.append(ending)

    def episode_ended(self, env: int, filled: Iterable[int], *, success: bool) -> None:
        """Record which options ran in an episode."""
        ran = self._ran.pop(env, set())
        for slot in filled if self.settings.min_reached > 0 else ():
            self._slots[slot].episodes.append(Episode(slot in ran, success))

    def counts_needs(self, options: OptionInstaller) -> bool:
        """Return whether the subgoals that successes pass are still counted."""
        counted = (len(self._slots[slot].needed) for slot, _ in _judged(options))
        return self.settings.min_reached > 0 and any(n < WINDOW for n in counted)

    def succeeded(self, options: OptionInstaller, features: FloatArray) -> None:
        """Record which subgoals a success passed, from φ of its states, (m, d)."""
        for slot, option in _judged(options):
            self._slots[slot].needed.append(bool(option.subgoal.contains(features).any()))

    def unneeded(self, options: OptionInstaller) -> int | None:
        """Return the slot whose subgoal fewest successes pass, if their share is below `NEEDED`."""
        records = {slot: self._slots[slot].needed for slot, _ in _judged(options)}
        shares = {slot: float(np.mean(of)) for slot, of in records.items() if len(of) >= MIN_SUCCESSES}
        weakest = min(shares, key=shares.__getitem__, default=None)
        return weakest if weakest is not None and shares[weakest] < NEEDED else None

    def judged(self, options: OptionInstaller) -> Iterator[tuple[int, SubgoalOption | Verdict]]:
        """Yield slots whose option loses states of I, with the narrowed option, or is to be closed, with the reason."""
        for slot, option in _judged(options):
            record = self._slots[slot]
            if len(record.new) < RUNS_BETWEEN:
                continue
            self._see(record, option, options)
            sure, likely = self._failing(record, option)
            least = self.settings.min_reached
            whole = verdict(record.last, record.episodes, least) if len(record.last) == WINDOW else None
            why = verdict(record.endings, record.episodes, least)
            lost = sure if why is not None else sure | likely
            if whole == "does not arrive":  # losing more states would not help
                yield slot, whole
            elif lost.any() and not lost.all():
                region = option.initiation_set
                self._remember(slot, option, region.points[lost])
                self.forget_runs(slot)
                yield slot, replace(option, initiation_set=replace(region, points=region.points[~lost]))
            elif why is not None:
                yield slot, why
            elif likely.any() and not helps(record.episodes):  # no state is left from which it arrives often enough
                yield slot, "does not arrive"

    def learned_anew(self, slot: int, later: SubgoalOption) -> SubgoalOption | None:
        """Return a relearned option without the states that I has lost, unless π acts differently there.

        A π that acts on observations is taken to act the same. Return None if I has no other state.
        """
        if slot in self._failed:
            region = later.initiation_set
            failed, did = self._failed[slot]
            does = later.option_policy.actions(failed) if later.policy_input == "features" else did
            failed = failed[does == did]
            kept = ~(region.points[:, None] == failed[None]).all(axis=2).any(axis=1)
            if not kept.any():
                return None
            later = replace(later, initiation_set=replace(region, points=region.points[kept]))
        self.forget_runs(slot)
        return later

    def forget(self, slot: int) -> None:
        """Forget a closed option."""
        self._slots.pop(slot, None)
        self._failed.pop(slot, None)

    def forget_runs(self, slot: int) -> None:
        """Forget the runs of an option that has changed."""
        self._slots[slot].new.clear()
        self._slots[slot].judged.clear()

    def forget_places(self) -> None:
        """Forget states that initiation sets lost and that runs passed, because φ has changed."""
        self._failed.clear()
        for record in self._slots.values():
            record.judged.clear()

    def _remember(self, slot: int, option: SubgoalOption, lost: FloatArray) -> None:
        """Remember states that an initiation set loses, and the actions of π there."""
        of_features = option.policy_input == "features"
        does = option.option_policy.actions(lost) if of_features else np.zeros(len(lost), dtype=np.int64)
        before, did = self._failed.get(slot, (lost[:0], does[:0]))
        self._failed[slot] = np.concatenate([before, lost]), np.concatenate([did, does])

    def _see(self, record: SlotRecord, option: SubgoalOption, options: OptionInstaller) -> None:
        """Keep the features of new runs that the initiation set sees: observations may be images."""
        observations, endings = zip(*record.new, strict=True)
        features = option.initiation_set.own(options.features_of(concatenate(list(observations))))
        parts = np.split(features, np.cumsum([batch_size(each) for each in observations[:-1]]))
        record.judged.extend(zip(parts, endings, strict=True))
        record.new.clear()

    def _failing(self, record: SlotRecord, option: SubgoalOption) -> tuple[BoolArray, BoolArray]:
        """Find centres of I from which too few runs arrive, (n,) each: by a test, or else by share.

        Failures of an option may be spread over many states, too few at each for the test. The share decides if the
        test rejects all runs together.
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
    """Return the options with a subgoal: a hand-made option names none."""
    filled = [(slot, options.bank[slot]) for slot in options.installed()]
    return [(slot, each) for slot, each in filled if isinstance(each, SubgoalOption) and len(each.subgoal.points)]
