"""`SubgoalDiscoveryCallback`: collects trajectories, calls discovery, installs options."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any

import torch

from sb3_options.callbacks.checks import check_arguments, check_training, groups_given, groups_here
from sb3_options.callbacks.discovery_log import DiscoveryClock, draw_discovery, log_discovery, step_seconds_of
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.callbacks.learned_features import GivenFeatures, check_learned, features_for
from sb3_options.callbacks.primitive_steps import PrimitiveStepsCallback
from sb3_options.callbacks.records import ClosedOption, DiscoveredOption, OptionStatistics, saved_for
from sb3_options.callbacks.summaries import describe_options, log_results, save_or_warn, settings_of
from sb3_options.callbacks.usefulness import Usefulness, Verdict
from sb3_options.checked import given_as
from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import DiscoveryMethod, MethodName, checked_method
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.discovery.static_filter import StaticFilter
from sb3_options.embedding.settings import EmbeddingSettings
from sb3_options.execution.above import monitor_primitive_steps
from sb3_options.execution.exploration import checked_share
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.success import SuccessRule, judged, reported_success, success_rule, tell_success
from sb3_options.experience.trajectories import EpisodeRecord, LabelledTrajectory, Trajectory
from sb3_options.options.bank import OptionBank, PresentOptions
from sb3_options.options.creation import OptionGrowth, joined, learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import PolicyInput
from sb3_options.options.proposals import Proposal
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.state import restore, state_of

SEGMENTS_PER_LOG = 4
"""Segments between two dumps of the log; SB3's default is as many episodes."""


class SubgoalDiscoveryCallback(PrimitiveStepsCallback):
    """Discovers options while a model trains (McGovern & Barto 2001, Table 1).

    Each episode's trajectory becomes a positive or negative bag, and diverse density is searched. A concept that
    remains a peak becomes the subgoal of a new option, whose initiation set and policy are learned from the saved
    trajectories. The option is installed in the next empty slot of every environment, and its head in the network is
    opened. In a continuing task, segments between peaks of reward take the place of episodes:
    ``DiscoverySettings(segmentation="peaks")``.

    The callback also makes ``num_timesteps`` count primitive steps (`PrimitiveStepsCallback` says what still counts
    decisions), installs the options in the environment of an ``EvalCallback`` beside it, and logs to TensorBoard.
    `bank` holds the options, `discoveries` says when and where each was found, `closed` which of them were closed
    again, `episodes` how many episodes (or segments) discovery has seen, and `history` how each of them went.

    Args:
        settings: How subgoals are found: a `DiscoverySettings`, or a mapping of its fields.
        option_settings: How options are learned; likewise.
        method: How subgoals are found: the name of a method, or a `DiscoveryMethod` of your own; by default what the
            settings say.
        success: Which trajectories make positive bags; by default ``info["is_success"]``, or, in an environment without
            it, a positive last reward above all earlier ones in a terminal state. Or a text, as `success_rule` has it.
            SB3 logs ``rollout/success_rate`` by it, but for ``segmentation="peaks"``.
        static_filter: What may be a subgoal; by default not near the start and end of a trajectory.
        groups: The features that make a concept together, each a `FeatureGroup` or a mapping of its fields; by default
            those that the environment or φ names. Without any, all features do.
        max_new_options: Most options to make, not counting closed ones; by default as many as there are slots.
        max_option_exploration: Largest share of all options among the random choices of DQN, QRDQN and OptionDQN.
        opening_share: MaskablePPO: share of the probability that the first option opens with where primitives are
            equally likely. The odds of the k-th against the primitives are 1/k of those. It is no cap on all options
            together: three at 0.5 open with 0.65. By default ``max_option_exploration``.
        embedding: How a feature map is learned: an `EmbeddingSettings`, or a mapping of its fields. For environments in
            ``OptionsWrapper(feature_map="temporal-distance")``.
        interruption: Whether options of DQN, QRDQN and OptionDQN end where going on is worth less than the best
            alternative (`execution.interruption`).
        usefulness: How options are judged by their use, and closed where they are of none: a `UsefulnessSettings`, or a
            mapping of its fields.
        primitive_rollouts: Whether ``n_steps`` of an on-policy algorithm counts primitive steps, not decisions.
        save_path: File for the options, written each time one is made; None writes nothing.
        hparams: Settings for TensorBoard's HParams tab; by default those of the algorithm and of discovery.
        seed: Of option policies that are networks.
        verbose: 1 prints each new option, and in the end, if there is none, why.

    Raises:
        TypeError: ``settings`` has an unknown field, or ``method`` is none.
        ValueError: A setting is out of its range.
    """

    STATE = (
        *("episodes", "history", "discoveries", "closed", "_made_here", "_generator"),
        *("discovery", "_statistics", "_useful", "_growth", "_features"),
    )

    def __init__(
        self,
        settings: DiscoverySettings | Mapping[str, Any] | None = None,
        option_settings: OptionLearningSettings | Mapping[str, Any] | None = None,
        *,
        method: MethodName | DiscoveryMethod | None = None,
        success: SuccessRule | str = reported_success,
        static_filter: StaticFilter | None = None,
        groups: Iterable[FeatureGroup | Mapping[str, Any]] | None = None,
        max_new_options: int | None = None,
        max_option_exploration: float = 0.5,
        opening_share: float | None = None,
        embedding: EmbeddingSettings | Mapping[str, Any] | None = None,
        interruption: bool = True,
        usefulness: UsefulnessSettings | Mapping[str, Any] | None = None,
        primitive_rollouts: bool = False,
        save_path: str | os.PathLike[str] | None = None,
        hparams: Mapping[str, Any] | None = None,
        seed: int = 0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose, primitive_rollouts=primitive_rollouts)
        self.settings = given_as(DiscoverySettings, {} if settings is None else settings)
        if isinstance(method, str):
            self.settings = dataclasses.replace(self.settings, method=method)
        self.method = checked_method(method)
        self.option_settings = given_as(OptionLearningSettings, {} if option_settings is None else option_settings)
        check_arguments(success, static_filter, max_new_options, save_path, hparams, seed)
        self.success = success_rule(success)
        self.static_filter = static_filter
        self.usefulness = given_as(UsefulnessSettings, {} if usefulness is None else usefulness)
        self.groups = groups_given(groups)
        self.max_new_options, self.interruption, self.save_path = max_new_options, interruption, save_path
        self.hparams = hparams
        self.max_option_exploration = checked_share(max_option_exploration)
        self.opening_share = checked_share(max_option_exploration if opening_share is None else opening_share)
        self.episodes, self.seed, self._began, self._ended = 0, seed, 0, True
        self.history: list[EpisodeRecord] = []
        self.discoveries: list[DiscoveredOption] = []
        self.discovery: Discovery | None = None
        self.closed: list[ClosedOption] = []
        self._made_here: set[int] = set()
        self._generator = torch.Generator().manual_seed(seed)
        self._statistics = OptionStatistics()
        self._useful = Usefulness(self.usefulness)
        self._growth = OptionGrowth()
        self._features = GivenFeatures()
        self.embedding = given_as(EmbeddingSettings, {} if embedding is None else embedding)
        self._clock: DiscoveryClock | None = None

    @property
    def bank(self) -> OptionBank:
        """A copy of the present options, which takes no others; an empty bank before training starts."""
        return PresentOptions(OptionBank(1, 0) if self._installer is None else self._installer.bank)

    def _on_training_start(self) -> None:
        self._ended, self._began, venv = True, len(self.history), self.training_env
        before = None if self._installer is None else self._installer.model
        check_training(self, before)
        self._start_counting()
        monitor_primitive_steps(venv)
        self._installer = OptionInstaller(
            self.model,
            venv,
            self.locals.get("callback"),
            max_option_exploration=self.max_option_exploration,
            opening_share=self.opening_share,
            interruption=self.interruption,
            earlier=self._installer,
        )
        self._made_here &= set(self._installer.bank.filled)  # a user may have taken some out
        self._features = features_for(self._features, self._installer, self.embedding, self.seed)
        own = self.method is not None or bool(self.groups)
        check_learned(self._features, self.settings, self.option_settings, own=own)
        if self.discovery is None:
            self.discovery = Discovery(
                self.settings,
                self.method,
                groups=groups_here(self.groups, venv),
                seed=self.seed,
                success=self.success,
                static_filter=self.static_filter,
                kind=venv.get_attr("traits", [0])[0].feature_kind,
                taken=[option.subgoal for option in self._options.bank.slots if isinstance(option, SubgoalOption)],
            )
        self.discovery.diary.step_seconds = step_seconds_of(self.model)
        for slot, option in enumerate(self._options.bank.slots):
            if isinstance(option, SubgoalOption) and slot not in self._made_here and not option.fixed:
                self._growth.adopted(slot)
        venv.env_method("set_slots", record=self.settings.reward_peaks() or True)
        self._clock, self._ended = DiscoveryClock(self._search.diary.seconds), False

    @property
    def _options(self) -> OptionInstaller:
        assert self._installer is not None  # made when training started
        return self._installer

    @property
    def _search(self) -> Discovery:
        assert self.discovery is not None  # made when training started
        return self.discovery

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if not self.episodes and self.settings.segmentation == "episodes" and self.max_new_options != 0:
            self._search.diary.no_end(self.num_timesteps, self.training_env.num_envs, self.settings.max_segment)

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        runs = list(map(OptionRun.from_info, infos))
        goes_on = self._count(runs)
        for env, (info, run) in enumerate(zip(infos, runs, strict=True)):
            if run.index >= 0:
                self._statistics.add(run)
            if "trajectory" in info:
                self._episode_ended(info.pop("trajectory"), info, env, run)
            elif run.inside:
                self._useful.add(run, env, success=None)
            for segment in info.pop("segments", ()):
                self._episode_ended(segment, {})
                # An algorithm without rollouts dumps its log when episodes end, and there may be no end.
                if self.episodes % SEGMENTS_PER_LOG == 0 and self._rollout_buffer is None:
                    self.logger.dump(self.num_timesteps)
        return goes_on

    def _episode_ended(
        self, trajectory: Trajectory, info: dict[str, Any], env: int = 0, run: OptionRun | None = None
    ) -> None:
        self.episodes += 1
        try:
            success, total = judged(self.success, trajectory), float(trajectory.rewards.sum())
            before = (each.success for each in islice(self.history, self._began, None))
            tell_success(info, success, trajectory, self.success, self.model.ep_success_buffer, before)
            self.history.append(EpisodeRecord(self.num_timesteps, total, success, len(trajectory)))
            if run is not None:
                if run.inside:
                    self._useful.add(run, env, success=success)
                self._useful.episode_ended(env, self._options.installed(), success=success)
            self._judge()
            self._learn_from(trajectory, success)
        except ValueError as error:  # one episode that cannot be used is no reason to end training
            self._search.diary.unusable(self.episodes, error)
        self._log()

    def _learn_from(self, trajectory: Trajectory, success: bool) -> None:
        discovers = self._may_discover()
        if success and self._wants_slot() and self._useful.counts_needs(self._options):
            self._useful.succeeded(self._options, self._options.features_of(trajectory.states))
        if not (discovers or (self.option_settings.grow and len(self._options.bank))):
            return
        labelled = self._search.add(trajectory, self._options.features_of(trajectory.states), success=success)
        if self._features.learn_if_due(self._search, self._options):
            self._useful.forget_places()
            *_, labelled = self._search.database
        if self.option_settings.grow:
            self._learn_further(labelled)
        may_tell = labelled.success or self._search.method.learns_from_failures
        if discovers and self._features.ready and may_tell and (subgoal := self._search.search()) is not None:
            self._make_option(subgoal)

    def _learn_further(self, labelled: LabelledTrajectory) -> None:
        for slot in self._options.installed():
            option = self._options.bank[slot]
            if not isinstance(option, SubgoalOption) or option.fixed:
                continue
            if not self._growth.is_due(slot, option.subgoal, labelled):
                continue
            later = self._learn(option.subgoal, option.name, option.policy_input)
            if later is not None and slot not in self._made_here:
                later = joined(option, later)
            later = later and self._useful.learned_anew(slot, later)
            if later is not None and later is not option:
                self._replace(slot, later)

    def _learn(self, proposal: Proposal, name: str, policy_input: PolicyInput) -> SubgoalOption | None:
        return learn_option(
            proposal,
            self._search.database,
            self._options.n_primitive,
            dataclasses.replace(self.option_settings, policy_input=policy_input),
            self._generator,
            name=name,
        )

    def _may_discover(self) -> bool:
        most = self._options.bank.max_options if self.max_new_options is None else self.max_new_options
        return len(self._made_here) < most and len(self._options.bank) < self._options.bank.max_options

    def _wants_slot(self) -> bool:
        """Whether discovery would go on if a slot were free."""
        full = len(self._options.installed()) == self._options.bank.max_options
        return full and (self.max_new_options is None or len(self._made_here) < self.max_new_options)

    def _make_option(self, subgoal: Region) -> None:
        found = self._search.found[-1]
        where = found.where(self._search.kind)
        try:
            option = self._learn(found.proposal or subgoal, f"reach {where}", self.option_settings.policy_input)
        except ValueError:
            self._search.withdraw()
            raise
        if option is None:
            self._search.diary.no_option(where, self._search.method.leads)
            return self._search.withdraw()
        slot = self._options.bank.slots.index(None)
        self._options.install(slot, option)
        self._features.remember(slot, option, self._search)
        self._statistics.forget(slot)  # a closed option went on to the end of its rollout, after it was forgotten
        self._useful.forget(slot)
        self._made_here.add(slot)
        if not option.fixed:
            self._growth.made(slot, subgoal, self._search.database)
        at = (self.episodes, self.num_timesteps, found.centre, where)
        last = (found.log_density, len(option.initiation_set.points), *saved_for(subgoal, self._search.database))
        self.discoveries.append(DiscoveredOption(slot, *at, *last))
        if self.verbose:
            print(f"Option {slot}: {option.name}, after {self.episodes} episodes and {self.num_timesteps:,} steps")
        save_or_warn(self._options.bank, self.save_path)
        self.draw()

    def _judge(self) -> None:
        """Narrow, or close, options that are of no use."""
        for slot, later in self._useful.judged(self._options):
            if isinstance(later, SubgoalOption):
                self._replace(slot, later)
            else:
                self._close_option(slot, later)
        if self._wants_slot() and (unneeded := self._useful.unneeded(self._options)) is not None:
            self._close_option(unneeded, "is not needed")

    def _replace(self, slot: int, later: SubgoalOption) -> None:
        self._options.replace(slot, later)
        self._features.remember(slot, later, self._search)

    def _close_option(self, slot: int, why: Verdict) -> None:
        self._options.uninstall(slot)
        self._features.forget(slot)
        self._made_here.discard(slot)
        self._statistics.forget(slot)
        self._useful.forget(slot)
        self._growth.forget(slot)
        self.closed.append(ClosedOption(slot, self.episodes, self.num_timesteps, why))
        self.closed[-1].tell(printed=self.verbose > 0)

    def _log(self) -> None:
        assert self._clock is not None  # made when training started
        others: dict[str, float] = {"options/count": len(self._options.bank), "options/closed": len(self.closed)}
        others |= {"time/primitive_steps": self.num_timesteps, **self._statistics.values(), **self._features.values()}
        log_discovery(self.logger.record, self._search, self._clock.share(self._search), others)

    def draw(self) -> None:
        """Draw discovery for TensorBoard, and describe the options, with the next dump of the log."""
        bank, made = self._options.bank, self.discoveries
        draw_discovery(self.logger, self._search, bank, made[-1].slot if made else None)
        describe_options(self.logger, bank.slots, made, self._statistics.values())

    def why_nothing(self) -> str | None:
        """Why no option was made since training started; None where one was."""
        if self.discoveries:
            return None
        if self.max_new_options == 0:
            return "Discovery was switched off."
        if self.discovery is None:
            return "No training has started."
        if (waits := self._features.why_not_ready(self.discovery.diary.n)) is not None:
            return waits
        if len(self.bank) == self.bank.max_options:
            return "There was no free slot for an option: raise max_options (--max-options)."
        return self.discovery.why_nothing(self.episodes)

    def get_state(self) -> dict[str, Any]:
        """For a checkpoint, at the start of a rollout."""
        return {**super().get_state(), **state_of(self)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint, once training has started."""
        restore(self, state)
        self._clock = DiscoveryClock(self._search.diary.seconds)
        self._features.resume(self._options)
        super().set_state(state)  # last: its options may need the feature map

    def _on_training_end(self) -> None:
        if self._ended:  # rl-zoo3 ends training twice, and when it was refused
            return
        self._ended = True
        super()._on_training_end()
        if self.closed or len(self._options.bank):  # without those that were closed, and as the others are now
            save_or_warn(self._options.bank, self.save_path)
        self.draw()
        if self.verbose and self.max_new_options != 0 and (why := self.why_nothing()) is not None:
            print(why)
        hparams = self.hparams or settings_of(
            self.model, self.method, discovery=self.settings, option=self.option_settings
        )
        log_results(self.logger, hparams, self.history, self.num_timesteps)
        if self.logger.name_to_value:  # an empty dump warns
            self.logger.dump(self.num_timesteps)
