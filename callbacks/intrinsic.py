"""`IntrinsicRewardCallback`: a bonus for novelty, added where advantages are computed."""

import math
from typing import Any, TypeAlias, get_args

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_options.callbacks.tree import check_every_step
from sb3_options.checked import is_number
from sb3_options.embedding.settings import LEARNED
from sb3_options.execution.features import MAX_FEATURES, flat_size
from sb3_options.execution.vec_env import as_wrapper_sees
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience import observations as obs_batch
from sb3_options.experience.observations import FloatArray, IntArray, Observations
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import novelty
from sb3_options.learning.episodic_novelty import EllipticalBonus, NovelD
from sb3_options.learning.novelty import BATCH, NoveltyKind, RandomNetworkDistillation, ReturnScale, StateCounts, Steps
from sb3_options.learning.rollout_buffer import add_bonuses

Novelty: TypeAlias = StateCounts | RandomNetworkDistillation | EllipticalBonus


class IntrinsicRewardCallback(BaseCallback):
    """Adds a bonus for novelty to the reward of every primitive step.

    The agent learns from r + w b(s, s') / σ. σ is the running standard deviation of the intrinsic return
    (`ReturnScale`), so the ``weight`` w means the same for every kind of bonus. An option of k primitive steps gets
    Σ γⁱ bᵢ over all k steps.

    It is for PPO, A2C and the other algorithms with rollouts: advantages and returns include the bonus (`add_bonuses`).
    Environments, monitors and evaluations see only the rewards of the task. It works beside `SubgoalDiscoveryCallback`
    or `PrimitiveStepsCallback`, in any order, and also without options.

    One value function covers both rewards, so a bonus ends with the episode, unlike that of Burda et al. (2018).

    Args:
        kind: ``counts``, 1 / √N for N visits to a state; ``rnd``, random network distillation; ``noveld``, the increase
            in ``rnd``'s novelty at the first visit in an episode; or ``e3b``, the distance from the episode's earlier
            observations in features learned by inverse dynamics. Observations of whole numbers, such as images, are
            counted as they are. For others the environment's ``concept_features``, or the feature map of
            `OptionsWrapper`, are rounded to whole numbers. Without either, the flat observation is rounded to
            twentieths of its range. The other kinds see the flat observation.
        weight: w, at least 0.
        seed: Seed of the networks' weights.

    Attributes:
        novelty: Counts or networks, made in the first training and kept for later ones.

    Raises:
        ValueError: An argument is out of its range or, when training starts, nothing can be counted or γ is 1.
        TypeError: When training starts, the algorithm has no rollouts, or ``e3b`` finds actions that are not discrete.
    """

    STATE = ("novelty", "scale", "_bonus_weight", "_begins", "_original")

    def __init__(self, kind: NoveltyKind = "counts", *, weight: float = 0.1, seed: int = 0) -> None:
        super().__init__()
        known = isinstance(kind, str) and kind in get_args(NoveltyKind)
        if not (known and is_number(weight) and 0.0 <= weight < math.inf):
            kinds = ", ".join(map(repr, get_args(NoveltyKind)))
            raise ValueError(
                f"kind must be one of {kinds}, and weight finite and at least 0, got {kind!r} and {weight!r}."
            )
        self.kind = kind
        self.weight = weight
        self.seed = seed
        self.novelty: Novelty | None = None
        self.scale: ReturnScale | None = None
        self._pending: list[tuple[IntArray, FloatArray, Steps]] = []  # steps without a bonus, their rows and γⁱ
        self._row = 0  # of the rollout
        self._bonus_weight = 0.0

    def _on_training_start(self) -> None:
        check_every_step(self)
        gamma: float = self.model.gamma  # type: ignore[attr-defined]  # every algorithm has it
        if gamma >= 1.0:
            raise ValueError(f"A bonus needs gamma below 1, or its return has no bound, got gamma={gamma}.")
        if not isinstance(getattr(self.model, "rollout_buffer", None), RolloutBuffer):
            raise TypeError(
                f"IntrinsicRewardCallback is for algorithms with rollouts, such as PPO and A2C: "
                f"{type(self.model).__name__} has none."
            )
        n_envs = self.training_env.num_envs
        self.scale = self.scale or ReturnScale(gamma, n_envs)
        if len(self.scale.returns) != n_envs:
            self.scale.returns = np.zeros(n_envs)
        self._has_options = any(self.training_env.env_is_wrapped(OptionsWrapper))
        self.novelty = self.novelty or self._new_novelty()
        self._begins = np.zeros(n_envs, dtype=bool)

    def _new_novelty(self) -> Novelty:
        venv = self.training_env
        space = venv.unwrapped.observation_space
        if self.kind == "rnd":
            return RandomNetworkDistillation(flat_size(space), self.seed)
        if self.kind == "noveld":
            return NovelD(flat_size(space), self.seed)
        if self.kind == "e3b":
            if not isinstance(venv.action_space, spaces.Discrete):
                raise TypeError(f"'e3b' predicts discrete actions, got {venv.action_space}: choose another kind.")
            n_actions = venv.get_attr("traits", [0])[0].n_primitive if self._has_options else int(venv.action_space.n)
            return EllipticalBonus(flat_size(space), n_actions, self.seed)
        if novelty.is_table_like(space):
            return StateCounts(obs_batch.flatten)
        # Counts in a learned feature map would mean something else later.
        learns = venv.has_attr("traits") and venv.get_attr("traits", [0])[0].feature_kind == LEARNED
        if venv.has_attr("concept_features") and not learns:
            return StateCounts(self._concept_features)
        if isinstance(space, spaces.Box) and np.prod(space.shape) <= MAX_FEATURES:
            return StateCounts(obs_batch.flatten, novelty.bin_widths(space))
        raise ValueError(
            f"There is nothing to count in {space}: pass OptionsWrapper(feature_map=...) a function from a batch of "
            "observations to features (batch, d), or choose another kind."
        )

    def _concept_features(self, observations: Observations) -> FloatArray:
        return np.asarray(self.training_env.env_method("concept_features", observations, indices=[0])[0])

    def _on_rollout_start(self) -> None:
        self._visit()  # steps of a rollout that an error ended
        buffer: RolloutBuffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # checked at the start
        self._sums = np.zeros((buffer.buffer_size, buffer.n_envs))  # Σ γⁱ bᵢ of each decision
        self._row = 0
        normalizer = self.model.get_vec_normalize_env()
        self._original = None if normalizer is None else normalizer.get_original_obs()

    def _on_step(self) -> bool:
        assert self.novelty is not None  # made when training started
        self._begins |= self.model._last_episode_starts
        before, after = self._observations()
        alike = []  # environments with one primitive step that did not end the episode
        for env, info in enumerate(self.locals["infos"]):
            run = OptionRun.from_info(info) if self._has_options else None
            if info.get("lost") or (run is not None and run.termination == "running"):
                continue  # it was no step, or it goes on and is reported when it ends
            if self.locals["dones"][env] or (run is not None and run.actions is not None):
                self._add_run(env, run, before, after)
            else:
                alike.append(env)
        if alike:
            self._add(np.array(alike), before, self.locals["actions"][alike], after)
        self._row += 1
        if sum(len(steps.envs) for *_, steps in self._pending) >= BATCH:
            self._visit()
        return True

    def _add(self, envs: IntArray, before: Observations, actions: IntArray, after: Observations) -> None:
        """Add a primitive step of each of these environments."""
        # Copies, because an environment may write into its last observations.
        steps = Steps(obs_batch.take(before, envs), actions, obs_batch.take(after, envs), envs, self._begins[envs])
        self._pending.append((np.full(len(envs), self._row), np.ones(len(envs)), steps))
        self._begins[envs] = False

    def _add_run(self, env: int, run: OptionRun | None, before: Observations, after: Observations) -> None:
        """Add all primitive steps of one environment."""
        here = [env]
        info = self.locals["infos"][env]
        before, after = obs_batch.take(before, here), obs_batch.take(after, here)
        if self.locals["dones"][env] and info.get("terminal_observation") is not None:
            last = obs_batch.batch_of_one(obs_batch.copy_of(info["terminal_observation"]))
            after = as_wrapper_sees(self.training_env, last, normalized=True)
        if run is not None and run.observations is not None:
            before = run.observations
            after = obs_batch.concatenate([obs_batch.take(before, slice(1, None)), after])
        actions = self.locals["actions"][here] if run is None or run.actions is None else run.actions
        n = np.arange(len(actions))
        steps = Steps(before, actions, after, np.full(len(n), env), n < self._begins[env])
        discounts = np.power(1.0 if run is None else run.gamma, n)
        self._pending.append((np.full(len(n), self._row), discounts, steps))
        self._begins[env] = False

    def _on_rollout_end(self) -> None:
        self._visit()
        buffer: RolloutBuffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # checked at the start
        add_bonuses(buffer, self._bonus_weight * self._sums)

    def _on_training_end(self) -> None:
        self._visit()  # of a rollout that was cut off

    def _visit(self) -> None:
        """Give the pending steps their bonuses, and learn from them."""
        assert self.novelty is not None  # made when training started
        assert self.scale is not None  # too
        if not self._pending:
            return
        parts = zip(*self._pending, strict=True)
        rows, discounts = np.concatenate(next(parts)), np.concatenate(next(parts))
        steps = Steps.joined(next(parts))
        self._pending.clear()
        order = np.lexsort((steps.envs, rows))  # steps of one run keep theirs
        rows, discounts = rows[order], discounts[order]
        steps = Steps(*(obs_batch.take(part, order) for part in steps))
        bonuses = self.novelty.bonuses(steps)
        np.add.at(self._sums, (rows, steps.envs), discounts * bonuses)
        self.scale.update([bonuses[steps.envs == env] for env in range(self.training_env.num_envs)])
        self._bonus_weight = self.weight / self.scale.std
        self.logger.record_mean("intrinsic/bonus", self._bonus_weight * float(np.mean(bonuses)))
        self.logger.record("intrinsic/return_std", self.scale.std)
        for name, value in self.novelty.records().items():
            self.logger.record(f"intrinsic/{name}", value)

    def _observations(self) -> tuple[Any, Any]:
        """Return the observations before and after the last step of all environments, as these gave them."""
        venv = self.training_env
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is None:
            last: Any = self.model._last_obs  # SB3 replaces it after the callbacks
            return as_wrapper_sees(venv, last), as_wrapper_sees(venv, self.locals["new_obs"])
        # The originals: normalisation may have clipped the others, and its statistics have changed.
        before, self._original = self._original, normalizer.get_original_obs()
        return as_wrapper_sees(normalizer.venv, before), as_wrapper_sees(normalizer.venv, self._original)
