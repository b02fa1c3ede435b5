"""`OptionKeeper`: makes options from subgoals, learns them further, and closes them, with records."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import torch

from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.callbacks.learned_features import LearnedFeatures
from sb3_options.callbacks.usefulness import Usefulness, Verdict
from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import LabelledTrajectory, Trajectory
from sb3_options.options.creation import OptionGrowth, joined, learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import PolicyInput
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.state import storable


@storable
@dataclass(frozen=True)
class DiscoveredOption:
    """When and where an option was made.

    Attributes:
        slot: Slot of the option.
        episode: Number of episodes, or of segments between peaks of reward, that had ended.
        timestep: Primitive steps taken.
        subgoal: The subgoal's centre in concept space, shape (d,).
        where: The subgoal in readable form: ``state 57`` of a discrete space, else coordinates.
        log_density: Best log diverse density of the search that found the subgoal; NaN for other methods.
        initiation_states: Size of the initiation set.
    """

    slot: int
    episode: int
    timestep: int
    subgoal: FloatArray
    where: str
    log_density: float
    initiation_states: int


@storable
@dataclass(frozen=True)
class ClosedOption:
    """When and why an option was closed.

    Attributes:
        slot: Slot of the option, which another may fill.
        episode: Number of episodes that had ended.
        timestep: Primitive steps taken.
        why: Reason for closing it.
    """

    slot: int
    episode: int
    timestep: int
    why: Verdict


class OptionKeeper:
    """Options that a training makes, and all that is known about them, by slot."""

    STATE: ClassVar[tuple[str, ...]] = ("discoveries", "closed", "made", "generator", "useful", "growth", "features")

    options: OptionInstaller
    search: Discovery

    def __init__(self, settings: OptionLearningSettings, usefulness: UsefulnessSettings) -> None:
        self.settings = settings
        self.most: int | None = None  # maximum number of options, not counting closed ones
        self.discoveries: list[DiscoveredOption] = []
        self.closed: list[ClosedOption] = []
        self.made: set[int] = set()
        self.generator = torch.Generator()
        self.useful = Usefulness(usefulness)
        self.growth = OptionGrowth()
        self.features: LearnedFeatures | None = None

    def begin(self, options: OptionInstaller, search: Discovery, most: int | None) -> None:
        """Adopt the options that exist when training starts."""
        self.options = options
        self.search = search
        self.most = most
        self.made &= set(self.options.bank.filled)  # a user may have taken some out
        for slot, option in enumerate(self.options.bank.slots):
            if isinstance(option, SubgoalOption) and slot not in self.made:
                self.growth.adopted(slot)

    def may_make(self) -> bool:
        """Return whether another option may be made now."""
        bank = self.options.bank
        most = bank.max_options if self.most is None else self.most
        return len(self.made) < most and len(bank) < bank.max_options

    def wants_slot(self) -> bool:
        """Return whether another option would be made if a slot were free."""
        full = len(self.options.installed()) == self.options.bank.max_options
        return full and (self.most is None or len(self.made) < self.most)

    def learn_from(
        self, trajectory: Trajectory, success: bool, episode: int, timestep: int, *, grow: bool
    ) -> DiscoveredOption | None:
        """Let discovery learn from a trajectory, and options if they may ``grow``. Return the new option, if any."""
        options = self.options
        search = self.search
        discovers = self.may_make()
        if success and self.wants_slot() and self.useful.counts_needs(options):
            self.useful.succeeded(options, options.features_of(trajectory.states))
        if not (discovers or (self.settings.grow and len(options.bank))):
            return None
        labelled = search.add(trajectory, options.features_of(trajectory.states), success=success)
        if self.features is not None and self.features.learn_if_due(search, options):
            self.useful.forget_places()
            *_, labelled = search.database
        if self.settings.grow and grow:
            self._learn_further(labelled)
        may_lead = labelled.success or search.method.learns_from_failures
        ready = self.features is None or self.features.ready
        if not (discovers and ready and may_lead):
            return None
        subgoal = search.search()
        return None if subgoal is None else self._make(subgoal, episode, timestep)

    def _make(self, subgoal: Region, episode: int, timestep: int) -> DiscoveredOption | None:
        """Learn and install an option for the subgoal that was found last; return None if none can be learned."""
        found = self.search.found[-1]
        where = found.where(self.search.kind)
        option = None
        try:
            option = self._learn(subgoal, f"reach {where}", self.settings.policy_input)
        finally:
            if option is None:
                self.search.withdraw()
        if option is None:
            self.search.diary.no_option(where)
            return None
        slot = self.options.bank.slots.index(None)
        self.options.install(slot, option)
        self._remember(slot, option)
        self.useful.forget(slot)  # a closed option ran on until its rollout ended, after it was forgotten
        self.made.add(slot)
        self.growth.made(slot, subgoal, self.search.database)
        n_states = len(option.initiation_set.points)
        made = DiscoveredOption(slot, episode, timestep, found.centre, where, found.log_density, n_states)
        self.discoveries.append(made)
        return made

    def _learn_further(self, labelled: LabelledTrajectory) -> None:
        """Relearn the options for which a trajectory is worth it."""
        for slot in self.options.installed():
            option = self.options.bank[slot]
            if not isinstance(option, SubgoalOption):
                continue
            if not self.growth.is_due(slot, option.subgoal, labelled):
                continue
            later = self._learn(option.subgoal, option.name, option.policy_input)
            if later is not None and slot not in self.made:
                later = joined(option, later)
            later = later and self.useful.learned_anew(slot, later)
            if later is not None and later is not option:
                self.replace(slot, later)

    def judge(self, episode: int, timestep: int) -> list[ClosedOption]:
        """Narrow the options that fail from some states, close useless ones, and return these."""
        before = len(self.closed)
        for slot, later in self.useful.judged(self.options):
            if isinstance(later, SubgoalOption):
                self.replace(slot, later)
            else:
                self._close(ClosedOption(slot, episode, timestep, later))
        if self.wants_slot() and (unneeded := self.useful.unneeded(self.options)) is not None:
            self._close(ClosedOption(unneeded, episode, timestep, "is not needed"))
        return self.closed[before:]

    def _close(self, closed: ClosedOption) -> None:
        """Take an option out of its slot."""
        slot = closed.slot
        self.options.uninstall(slot)
        self.made.discard(slot)
        for of_slots in (self.features, self.useful, self.growth):
            if of_slots is not None:
                of_slots.forget(slot)
        self.closed.append(closed)

    def why_nothing(self, episodes: int) -> str | None:
        """Return why no option was made in so many episodes, or None if one was."""
        if self.discoveries:
            return None
        if self.features is not None and (waits := self.features.why_not_ready(self.search.diary.n)) is not None:
            return waits
        if len(self.options.bank) == self.options.bank.max_options:
            return "There was no free slot for an option: raise max_options (--max-options)."
        return self.search.why_nothing(episodes)

    def _learn(self, subgoal: Region, name: str, policy_input: PolicyInput) -> SubgoalOption | None:
        settings = dataclasses.replace(self.settings, policy_input=policy_input)
        n_primitive = self.options.n_primitive
        return learn_option(subgoal, self.search.database, n_primitive, settings, self.generator, name=name)

    def replace(self, slot: int, later: SubgoalOption) -> None:
        """Put a later version of an option into its slot."""
        self.options.replace(slot, later)
        self._remember(slot, later)

    def _remember(self, slot: int, option: SubgoalOption) -> None:
        if self.features is not None:
            self.features.remember(slot, option, self.search)
