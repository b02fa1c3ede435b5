"""`IntrinsicRewardCallback`: a bonus for novelty, added where advantages are computed."""

from __future__ import annotations

import math
from typing import get_args

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
from sb3_options.experience.observations import FloatArray, Observations
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning import novelty
from sb3_options.learning.novelty import NoveltyKind, RandomNetworkDistillation, ReturnScale, StateCounts
from sb3_options.learning.rollout_buffer import add_bonuses


class IntrinsicRewardCallback(BaseCallback):
    """Adds a bonus for novelty to the reward of every primitive step.

    The agent learns from r + w b(s') / σ. σ is the running standard deviation of the intrinsic return (`ReturnScale`),
    so the ``weight`` w means the same for every kind of bonus. An option of k primitive steps gets Σ γⁱ bᵢ over all k
    steps.

    It is for PPO, A2C and the other algorithms with rollouts: advantages and returns include the bonus (`add_bonuses`).
    Environments, monitors and evaluations see only the rewards of the task. It works beside `SubgoalDiscoveryCallback`
    or `PrimitiveStepsCallback`, in any order, and also without options.

    One value function covers both rewards, so a bonus ends with the episode, unlike that of Burda et al. (2018).

    Args:
        kind: ``counts``, 1 / √N for N visits to a state; or ``rnd``, random network distillation. Observations of whole
            numbers, such as images, are counted as they are. For others the environment's ``concept_features``, or the
            feature map of `OptionsWrapper`, are rounded to whole numbers. Without either, the flat observation is
            rounded to twentieths of its range. ``rnd`` sees the flat observation.
        weight: w, at least 0.
        seed: Seed of the networks' weights.

    Attributes:
        novelty: Counts or networks, made in the first training and kept for later ones.

    Raises:
        ValueError: An argument is out of its range or, when training starts, nothing can be counted or γ is 1.
        TypeError: When training starts, the algorithm has no rollouts.
    """

    STATE = ("novelty", "scale", "_bonus_weight")

    def __init__(self, kind: NoveltyKind = "counts", *, weight: float = 0.1, seed: int = 0) -> None:
        super().__init__()
        if (
            not isinstance(kind, str)
            or kind not in get_args(NoveltyKind)
            or not (is_number(weight) and 0.0 <= weight < math.inf)
        ):
            raise ValueError(
                f"kind must be 'counts' or 'rnd', and weight finite and at least 0, got {kind!r} and {weight!r}."
            )
        self.kind = kind
        self.weight = weight
        self.seed = seed
        self.novelty: StateCounts | RandomNetworkDistillation | None = None
        self.scale: ReturnScale | None = None
        self._sums: list[list[float]] = []
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
        self.novelty = self.novelty or self._new_novelty()
        self._has_options = any(self.training_env.env_is_wrapped(OptionsWrapper))

    def _new_novelty(self) -> StateCounts | RandomNetworkDistillation:
        venv = self.training_env
        space = venv.unwrapped.observation_space
        if self.kind == "rnd":
            return RandomNetworkDistillation(flat_size(space), self.seed)
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
            "observations to features (batch, d), or choose 'rnd'."
        )

    def _concept_features(self, observations: Observations) -> FloatArray:
        return np.asarray(self.training_env.env_method("concept_features", observations, indices=[0])[0])

    def _on_rollout_start(self) -> None:
        self._sums.clear()

    def _on_step(self) -> bool:
        assert self.novelty is not None  # made when training started
        assert self.scale is not None  # too
        runs = [OptionRun.from_info(info) if self._has_options else None for info in self.locals["infos"]]
        arrived = [_arrived_in(run, last) for run, last in zip(runs, self._last_observations(), strict=True)]
        if not any(map(obs_batch.batch_size, arrived)):  # all environments wait for their options to end
            self._sums.append([0.0] * len(runs))
            return True
        ends = np.cumsum([obs_batch.batch_size(each) for each in arrived])[:-1]
        bonuses = np.split(self.novelty.visit(obs_batch.concatenate(arrived)), ends)  # of primitive steps, (k,) each
        self._sums.append([_discounted(run, of_run) for run, of_run in zip(runs, bonuses, strict=True)])
        self.scale.update(bonuses)
        self._bonus_weight = self.weight / self.scale.std
        self.logger.record_mean("intrinsic/bonus", self._bonus_weight * float(np.mean(np.concatenate(bonuses))))
        self.logger.record("intrinsic/return_std", self.scale.std)
        for name, value in self.novelty.records().items():
            self.logger.record(f"intrinsic/{name}", value)
        return True

    def _on_rollout_end(self) -> None:
        buffer: RolloutBuffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # checked at the start
        add_bonuses(buffer, self._bonus_weight * np.array(self._sums))

    def _last_observations(self) -> list[Observations]:
        """Return the last observation of each environment, unnormalised, as a batch of one."""
        normalizer = self.model.get_vec_normalize_env()
        venv = self.training_env
        if normalizer is None:
            given = as_wrapper_sees(venv, self.locals["new_obs"])
        else:  # the originals: normalisation may have clipped the others
            given = as_wrapper_sees(normalizer.venv, normalizer.get_original_obs())
        last = [obs_batch.take(given, slice(i, i + 1)) for i in range(venv.num_envs)]
        for i, (done, info) in enumerate(zip(self.locals["dones"], self.locals["infos"], strict=True)):
            if done and info.get("terminal_observation") is not None:
                last[i] = as_wrapper_sees(venv, obs_batch.batch_of_one(info["terminal_observation"]), normalized=True)
        return last


def _arrived_in(run: OptionRun | None, last: Observations) -> Observations:
    """Return the observations that the primitive steps of a run led to, ending with ``last``."""
    if run is not None and run.duration == 0:  # it goes on, and reports its observations when it ends
        nothing: Observations = obs_batch.take(last, slice(0, 0))
        return nothing
    if run is None or run.observations is None:
        return last
    return obs_batch.concatenate([obs_batch.take(run.observations, slice(1, None)), last])


def _discounted(run: OptionRun | None, bonuses: FloatArray) -> float:
    """Return Σ γⁱ bᵢ over the primitive steps of a run."""
    if run is None or len(bonuses) == 1:
        return float(bonuses[0])
    return float(run.gamma ** np.arange(len(bonuses)) @ bonuses)
