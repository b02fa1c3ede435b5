"""`SubgoalDiscoveryCallback`: collects trajectories, calls discovery, installs options."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any

from sb3_options.callbacks.checks import check_training
from sb3_options.callbacks.cloning import MarginLoss, can_clone, clone, fit_values
from sb3_options.callbacks.demonstrated import labelled, with_failures
from sb3_options.callbacks.installer import OptionInstaller
from sb3_options.callbacks.keeper import OptionKeeper
from sb3_options.callbacks.learned_features import check_learned, features_for
from sb3_options.callbacks.primitive_steps import PrimitiveStepsCallback
from sb3_options.callbacks.settings import ConceptSettings, OptionUse
from sb3_options.callbacks.summaries import draw_discovery, log_discovery, log_run, log_settings, save_or_warn
from sb3_options.callbacks.tree import all_callbacks
from sb3_options.checked import given_as
from sb3_options.checkpoints.demonstrations import MANY
from sb3_options.density.groups import checked_groups
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import DiscoveryMethod, MethodName, checked_method
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.execution.slots import Traits
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.success import SuccessRule, judged, reported_success, success_rule, tell_success
from sb3_options.experience.trajectories import EpisodeRecord, Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.option import SubgoalOption
from sb3_options.options.settings import OptionLearningSettings, UsefulnessSettings
from sb3_options.state import restore

SEGMENTS_PER_LOG = 4  # segments between two dumps of the log; SB3's default is 4 episodes

SETTLED, SETTLED_EPISODES = 0.7, 50
"""Success rate in the last so many episodes from which the options of a policy that was cloned from `MANY`
demonstrations are not learned anew: relearning changes the actions that the policy was fitted to. Such episodes do not
count towards it. Options from fewer demonstrations start in too few states to stay."""


class SubgoalDiscoveryCallback(PrimitiveStepsCallback):
    """Discovers options while a model trains (McGovern & Barto 2001, Table 1).

    Each episode's trajectory becomes a positive or negative bag, and discovery searches for peaks of diverse density. A
    concept that remains a peak becomes the subgoal of a new option, whose initiation set and policy are learned from
    the saved trajectories. The option fills the next empty slot of every environment, including those of an
    ``EvalCallback``, and its head in the network is opened. The callback also makes ``num_timesteps`` count primitive
    steps (`PrimitiveStepsCallback`), and logs to TensorBoard.

    Args:
        settings: How subgoals are found: a `DiscoverySettings`, or a mapping of its fields, as for all settings here.
        option_settings: How options are learned: `OptionLearningSettings`.
        method: Name of a discovery method, or a `DiscoveryMethod` of your own; by default the method of the settings.
        success: Rule for trajectories that make positive bags: a function, or a text for `success_rule`. The default is
            ``info["is_success"]`` or, in an environment without it, a positive last reward above all earlier ones in a
            terminal state. SB3 logs ``rollout/success_rate`` by this rule, except for ``segmentation="peaks"``.
        max_new_options: Most options to make, not counting closed ones; by default the number of slots.
        concepts: The space in which subgoals are searched: `ConceptSettings`.
        use: How the algorithm uses options: `OptionUse`.
        usefulness: How options are judged, and useless ones closed: `UsefulnessSettings`.
        demonstrations: Successful trajectories from `record_demonstrations`, or a file of them. They yield options
            before the first step. If they hold no failures, a random policy provides some.
        clone: Whether the policy first clones the decisions of the demonstrations; not for RecurrentPPO and MacroQ.
            The replay buffer of DQN, QRDQN and OptionDQN begins with the demonstrations, and a margin in favour of
            these decisions stays in their loss, with a falling weight (Hester et al. 2018).
        verbose: 1 prints each new option, the learning of a feature map and, if no option was made, the reason.

    `bank` holds the options, `discoveries` when and where each was found, `closed` the closed options, and `history`
    the results of episodes. If `save_path` is set, the options are saved each time one is made. `hparams` are the
    settings for TensorBoard's HParams tab, by default those of discovery and options.

    Raises:
        ValueError: A setting is out of its range, or something does not fit when training starts. The message says what
            to change.
        TypeError: An argument is of the wrong kind.
    """

    STATE = ("episodes", "history", "discovery", "_keeper", "_cloned_at", "_margin")

    def __init__(
        self,
        settings: DiscoverySettings | Mapping[str, Any] | None = None,
        option_settings: OptionLearningSettings | Mapping[str, Any] | None = None,
        *,
        method: MethodName | DiscoveryMethod | None = None,
        success: SuccessRule | str = reported_success,
        max_new_options: int | None = None,
        concepts: ConceptSettings | Mapping[str, Any] | None = None,
        use: OptionUse | Mapping[str, Any] | None = None,
        usefulness: UsefulnessSettings | Mapping[str, Any] | None = None,
        demonstrations: Iterable[Trajectory] | str | os.PathLike[str] | None = None,
        clone: bool = True,
        verbose: int = 0,
    ) -> None:
        if isinstance(settings, Mapping) and "callback" in settings:  # SB3 calls a class with its locals
            raise TypeError("The callback is a class: pass an object, callback=SubgoalDiscoveryCallback().")
        self.use = given_as(OptionUse, {} if use is None else use)
        super().__init__(verbose, primitive_rollouts=self.use.primitive_rollouts)
        self.settings = given_as(DiscoverySettings, {} if settings is None else settings)
        if isinstance(method, str):
            self.settings = dataclasses.replace(self.settings, method=method)
        self.method = checked_method(method)
        self.option_settings = given_as(OptionLearningSettings, {} if option_settings is None else option_settings)
        self.concepts = given_as(ConceptSettings, {} if concepts is None else concepts)
        self.embedding = self.concepts.embedding
        self.success = success_rule(success)
        self.max_new_options = max_new_options
        self.save_path: str | os.PathLike[str] | None = None
        self.hparams: Mapping[str, Any] | None = None
        self.demonstrations = demonstrations
        self.clone = clone
        self.episodes = 0
        self.history: list[EpisodeRecord] = []
        self.discovery: Discovery | None = None
        judging = given_as(UsefulnessSettings, {} if usefulness is None else usefulness)
        self._keeper = OptionKeeper(self.option_settings, judging)
        self.discoveries = self._keeper.discoveries
        self.closed = self._keeper.closed
        self._began = 0
        self._cloned_at: int | None = None  # episodes before the policy was cloned from many demonstrations
        self._margin: MarginLoss | None = None
        self._ended = True

    @property
    def bank(self) -> OptionBank:
        """Copy of the present options; an empty bank before training starts. Environments have banks of their own."""
        return OptionBank(1, 0) if self._installer is None else self._installer.bank.copy()

    def _on_training_start(self) -> None:
        self._ended = True
        self._began = len(self.history)
        venv = self.training_env
        keeper = self._keeper
        seed = self.model.seed or 0
        given = all_callbacks(self.locals.get("callback"))
        if sum(isinstance(each, SubgoalDiscoveryCallback) for each in given) > 1:
            raise ValueError("Two SubgoalDiscoveryCallbacks would compete for trajectories and slots: pass only one.")
        check_training(self, None if self._installer is None else self._installer.model)
        self._start_counting()
        use = self.use
        self._installer = OptionInstaller(
            self.model, venv, self.locals.get("callback"), max_option_exploration=use.max_option_exploration
        )
        keeper.features = features_for(keeper.features, self._installer, self.embedding, seed, self.verbose)
        if keeper.features is not None:
            check_learned(self.settings, self.option_settings, own=bool(self.method or self.concepts.groups))
        begins = self.discovery is None
        if self.discovery is None:
            keeper.generator.manual_seed(seed)
            traits: Traits = venv.get_attr("traits", [0])[0]
            groups = traits.feature_groups if self.concepts.groups is None else self.concepts.groups
            if traits.feature_size is not None:
                groups = checked_groups(groups, traits.feature_size)
            self.discovery = Discovery(
                self.settings,
                self.method,
                groups=groups,
                seed=seed,
                success=self.success,
                static_filter=self.concepts.static_filter,
                kind=traits.feature_kind,
                taken=[each.subgoal for each in self._installer.bank.slots if isinstance(each, SubgoalOption)],
            )
        keeper.begin(self._installer, self.discovery, self.max_new_options)
        self.discovery.diary.step_seconds = self._installer.family.step_seconds
        peaks = self.settings.segmentation == "peaks"
        venv.env_method("set_slots", record=True, max_segment=self.settings.max_segment if peaks else None)
        self._ended = False
        if self._margin is not None:
            self._margin.model, self._margin.bank = self.model, self._installer.bank
        if begins and self.demonstrations is not None:
            self._learn_from_demonstrations(self.demonstrations, seed)

    def _learn_from_demonstrations(self, given: Iterable[Trajectory] | str | os.PathLike[str], seed: int) -> None:
        shown = labelled(given, self.training_env, self.success)
        if self._keeper.may_make():
            for trajectory, success in with_failures(shown, self.training_env, self.success, seed):
                self._learn_from(trajectory, success)
            self.model._last_obs = self.training_env.reset()  # type: ignore[assignment]  # as in SB3's own code
            if (normalizer := self.model.get_vec_normalize_env()) is not None:
                self.model._last_original_obs = normalizer.get_original_obs()
        if self.clone and can_clone(self.model):
            self._clone([each for each, success in shown if success])

    def _clone(self, successes: list[Trajectory]) -> None:
        options = self._keeper.options
        options.on_rollout_start()  # no rollout has started, and the heads must be open
        buffer = options.family.replay_buffer
        if buffer is None:
            about = f": mean probability of a decision {clone(self.model, options.bank, successes):.2f}"
        else:
            self._margin = MarginLoss(self.model, options.bank, successes)
            fit_values(self._margin, buffer)
            about = ""
        if len(successes) >= MANY:
            self._cloned_at = len(self.history)
        if self.verbose:
            print(f"Cloned {len(successes)} demonstrations{about}")

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        runs = list(map(OptionRun.from_info, infos))
        goes_on = self._count(runs)
        for env, (info, run) in enumerate(zip(infos, runs, strict=True)):
            if run.index >= 0:
                log_run(self.logger, run)
            if "trajectory" in info:
                self._episode_ended(info.pop("trajectory"), info, env, run)
            elif run.inside:
                self._keeper.useful.add(run, env, success=None)
            for segment in info.pop("segments", ()):
                self._episode_ended(segment, {})
                # An algorithm without rollouts dumps its log when episodes end, and these may never end.
                if self.episodes % SEGMENTS_PER_LOG == 0 and self._rollout_buffer is None:
                    self.logger.dump(self.num_timesteps)
        return goes_on

    def _on_rollout_start(self) -> None:
        if self._margin is not None:
            self._margin.end()  # between rollouts only, so that an error in an environment leaves nothing behind
        super()._on_rollout_start()

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        if self._margin is not None:
            self._margin.begin()

    def _episode_ended(
        self, trajectory: Trajectory, info: dict[str, Any], env: int = 0, run: OptionRun | None = None
    ) -> None:
        self.episodes += 1
        useful = self._keeper.useful
        try:
            success = judged(self.success, trajectory)
            before = (each.success for each in islice(self.history, self._began, None))
            tell_success(info, success, trajectory, self.success, self.model.ep_success_buffer, before)
            record = EpisodeRecord(self.num_timesteps, float(trajectory.rewards.sum()), success, len(trajectory))
            self.history.append(record)
            if run is not None:
                if run.inside:
                    useful.add(run, env, success=success)
                useful.episode_ended(env, self._keeper.options.installed(), success=success)
            for closed in self._keeper.judge(self.episodes, self.num_timesteps):
                if self.verbose:
                    print(f"Option {closed.slot} {closed.why} and is closed, after {self.episodes} episodes")
            self._learn_from(trajectory, success)
        except ValueError as error:  # one unusable episode must not end training
            self._keeper.search.diary.unusable(self.episodes, error)
        log_discovery(self.logger, self._keeper, self.num_timesteps)

    def _learn_from(self, trajectory: Trajectory, success: bool) -> None:
        grow = not self._is_settled()
        made = self._keeper.learn_from(trajectory, success, self.episodes, self.num_timesteps, grow=grow)
        if made is None:
            return
        if self.verbose:
            steps = f"{self.num_timesteps:,}"
            print(f"Option {made.slot}: reach {made.where}, after {self.episodes} episodes and {steps} steps")
        save_or_warn(self._keeper.options.bank, self.save_path)
        draw_discovery(self.logger, self._keeper)

    def _is_settled(self) -> bool:
        """Return whether a policy cloned from many demonstrations succeeds so often that its options stay."""
        if self._cloned_at is None or len(self.history) == self._cloned_at:
            return False
        recent = self.history[max(self._cloned_at, len(self.history) - SETTLED_EPISODES) :]
        return sum(episode.success for episode in recent) >= SETTLED * len(recent)

    def why_nothing(self) -> str | None:
        """Return why no option was made since training started, or None if one was."""
        if self.max_new_options == 0 and not self.discoveries:
            return "Discovery was switched off."
        return "No training has started." if self.discovery is None else self._keeper.why_nothing(self.episodes)

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint, once training has started."""
        if (state["_margin"] is None) != (self._margin is None):
            raise ValueError(
                "Only one of checkpoint and model has values fitted to demonstrations: pass "
                "SubgoalDiscoveryCallback the same demonstrations and clone as before."
            )
        restore(self, state)
        if self._keeper.features is not None:
            self._keeper.options.send_learned_map()

    def _on_training_end(self) -> None:
        if self._ended:  # rl-zoo3 ends training twice, and also after a refusal
            return
        self._ended = True
        if self._margin is not None:
            self._margin.end()
        super()._on_training_end()
        if self.closed or len(self.bank):  # without closed options, and with the present state of the others
            save_or_warn(self._keeper.options.bank, self.save_path)
        draw_discovery(self.logger, self._keeper)
        if self.verbose and self.max_new_options != 0 and (why := self.why_nothing()) is not None:
            print(why)
        self.logger.record("time/primitive_steps", self.num_timesteps)
        discovery, option = dataclasses.asdict(self.settings), dataclasses.asdict(self.option_settings)
        own = {"algo": type(self.model).__name__, "discovery": discovery, "option": option}
        log_settings(self.logger, self.hparams or own)
        self.logger.dump(self.num_timesteps)
