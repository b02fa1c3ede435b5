"""`IntrinsicRewardCallback`: a bonus for what is new, added where advantages and targets are computed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_options.callbacks.counting import all_callbacks, check_every_step
from sb3_options.checked import is_number
from sb3_options.embedding.settings import LEARNED
from sb3_options.execution.features import MAX_FEATURES, flat_size
from sb3_options.execution.vec_env import as_wrapper_sees, space_of_environments
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.observations import (
    FloatArray,
    Observations,
    batch_of_one,
    batch_size,
    concatenate,
    flatten,
    take,
)
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.novelty import (
    Keys,
    NoveltyKind,
    RandomNetworkDistillation,
    ReturnScale,
    StateCounts,
    bin_widths,
    binned_keys,
    exact_keys,
    is_table_like,
)
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.learning.rollout_buffer import add_bonuses


class IntrinsicRewardCallback(BaseCallback):
    """Adds a bonus to the reward of every primitive step that arrives in what is new.

    The agent learns from r + w b(s') / σ. σ is the running standard deviation of the intrinsic return
    (`ReturnScale`), so that w, the ``weight``, means the same for every kind of bonus. An option of k primitive steps
    gets Σ γⁱ bᵢ over all of them, also those inside.

    Advantages and returns of PPO, A2C and the other algorithms with rollouts are those of rewards with the bonus
    (`add_bonuses`). DQN and the other algorithms with an `OptionReplayBuffer` get it when they sample a batch, as it is
    by then: what was new when it was stored may be well known. Environments, monitors and evaluations see the rewards
    of the task alone. It works beside `SubgoalDiscoveryCallback` or `PrimitiveStepsCallback`, in any order, and with
    rollouts also without options.

    There is one value function for both rewards, so a bonus ends with the episode, which that of Burda et al. (2018)
    does not.

    Args:
        kind: ``counts``, 1 / √N of the visits to a state; or ``rnd``, random network distillation. Observations of
            whole numbers are counted as they are, images among them. Of others the environment's ``concept_features``,
            or the feature map of `OptionsWrapper`, are rounded to whole numbers, or else the flat observation to
            twentieths of its range. ``rnd`` sees the flat observation.
        weight: w, at least 0.
        seed: Of the networks' weights.

    Attributes:
        novelty: Counts or networks, from the first training on; a later training goes on with them.

    Raises:
        ValueError: An argument is out of its range; or, when training starts, there is nothing that can be counted, or
            γ is 1.
        TypeError: When training starts, the algorithm has no buffer that a bonus could be added to.
    """

    STATE = ("novelty", "scale", "_bonus_weight")

    def __init__(self, kind: NoveltyKind = "counts", *, weight: float = 0.1, seed: int = 0) -> None:
        super().__init__()
        if not (isinstance(kind, str) and kind in ("counts", "rnd")):
            raise ValueError(f"kind must be 'counts' or 'rnd', got {kind!r}.")
        if not (is_number(weight) and 0.0 <= weight < math.inf):
            raise ValueError(f"weight must be at least 0 and finite, got {weight!r}.")
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
        self._check_buffers()
        if self.scale is None:
            self.scale = ReturnScale(gamma, self.training_env.num_envs)
        elif len(self.scale.returns) != self.training_env.num_envs:
            self.scale.returns = np.zeros(self.training_env.num_envs)
        if self.novelty is None:
            self.novelty = self._new_novelty(space_of_environments(self.training_env))
        self._has_options = any(self.training_env.env_is_wrapped(OptionsWrapper))
        if self._replay is not None:
            both = [each for each in all_callbacks(self.locals.get("callback")) if isinstance(each, type(self))]
            if len(both) > 1:
                raise ValueError(
                    f"learn() got {len(both)} IntrinsicRewardCallbacks, and a replay buffer adds one bonus: leave the "
                    "others out."
                )

    def _check_buffers(self) -> None:
        """Refuse an algorithm without a buffer, or with one that does not hold what a bonus is for."""
        if not isinstance(getattr(self.model, "rollout_buffer", self._replay), RolloutBuffer | OptionReplayBuffer):
            raise TypeError(
                f"{type(self.model).__name__} has no rollout buffer and no OptionReplayBuffer, which a bonus could be "
                "added to: IntrinsicRewardCallback is for PPO, A2C, DQN and the like; pass "
                "replay_buffer_class=OptionReplayBuffer."
            )
        if self._replay is not None and not self._replay.macro_q:
            raise ValueError(
                "The bonus of an option is that of the primitive steps inside it, which a replay buffer with "
                "macro_q=False does not store: leave out replay_buffer_kwargs={'macro_q': False}."
            )

    @property
    def _replay(self) -> OptionReplayBuffer | None:
        return getattr(self.model, "replay_buffer", None)

    def _new_novelty(self, space: spaces.Space[Any]) -> StateCounts | RandomNetworkDistillation:
        if self.kind == "counts":
            return StateCounts(self._keys(space))
        return RandomNetworkDistillation(flat_size(space), self.seed)

    def _keys(self, space: spaces.Space[Any]) -> Keys:
        if is_table_like(space):
            return exact_keys(space)
        if self.training_env.has_attr("concept_features") and not self._learns_features():
            return binned_keys(self._concept_features)
        if isinstance(space, spaces.Box) and np.prod(space.shape) <= MAX_FEATURES:
            return binned_keys(flatten, bin_widths(space))
        raise ValueError(
            f"There is nothing to count in {space}: pass OptionsWrapper(feature_map=...) a function from a batch of "
            "observations to features (batch, d), or choose 'rnd'."
        )

    def _learns_features(self) -> bool:
        """Whether φ is learned while training goes on: what was counted in it would be something else later."""
        venv = self.training_env
        return venv.has_attr("traits") and venv.get_attr("traits", [0])[0].feature_kind == LEARNED

    def _concept_features(self, observations: Observations) -> FloatArray:
        features: FloatArray = self.training_env.env_method("concept_features", observations, indices=[0])[0]
        return features

    def _on_rollout_start(self) -> None:
        self._sums.clear()
        if self._replay is not None:
            # Nothing is sampled in a rollout; what an exception ends there leaves the buffer as it was.
            self._replay.bonus = None

    def _on_step(self) -> bool:
        runs = [OptionRun.from_info(info) if self._has_options else None for info in self.locals["infos"]]
        arrived = [_arrived_in(run, last) for run, last in zip(runs, self._last_observations(), strict=True)]
        bonuses = self._visit(arrived)
        self._bonus_weight = self._weight_after(bonuses)
        self._sums.append([_discounted(run, of_run) for run, of_run in zip(runs, bonuses, strict=True)])
        return True

    def _on_rollout_end(self) -> None:
        if self._replay is not None:
            self._replay.bonus = self._bonus_now
        else:
            buffer: RolloutBuffer = self.model.rollout_buffer  # type: ignore[attr-defined]  # checked at the start
            add_bonuses(buffer, self._bonus_weight * np.array(self._sums))

    def _on_training_end(self) -> None:
        if self._replay is not None:
            self._replay.bonus = None

    def _bonus_now(self, observations: Observations) -> FloatArray:
        """The present bonus of observations as a replay buffer stores them: not normalised."""
        assert self.novelty is not None  # made when training started
        normalizer = self.model.get_vec_normalize_env()
        venv = self.training_env if normalizer is None else normalizer.venv
        return self._bonus_weight * self.novelty.of(as_wrapper_sees(venv, observations))

    def _last_observations(self) -> list[Observations]:
        """Where each environment arrived, as it gave it itself: a batch of one each."""
        normalizer, venv = self.model.get_vec_normalize_env(), self.training_env
        if normalizer is None:
            given = as_wrapper_sees(venv, self.locals["new_obs"])
        else:  # the originals: what was clipped is lost in the others
            given = as_wrapper_sees(normalizer.venv, normalizer.get_original_obs())
        last = [take(given, slice(i, i + 1)) for i in range(venv.num_envs)]
        for i, (done, info) in enumerate(zip(self.locals["dones"], self.locals["infos"], strict=True)):
            if done and info.get("terminal_observation") is not None:
                last[i] = as_wrapper_sees(venv, batch_of_one(info["terminal_observation"]), normalized=True)
        return last

    def _visit(self, arrived: list[Observations]) -> list[FloatArray]:
        """The bonuses of the primitive steps of each environment, not yet weighted, (k,) each."""
        together = concatenate(arrived)
        assert self.novelty is not None  # made when training started
        ends = np.cumsum([batch_size(each) for each in arrived])[:-1]
        return np.split(self.novelty.visit(together), ends)

    def _weight_after(self, bonuses: list[FloatArray]) -> float:
        """Let σ go on by these bonuses; then w / σ, which is logged."""
        assert self.novelty is not None  # made when training started
        assert self.scale is not None  # likewise
        self.scale.update(bonuses)
        weight = self.weight / self.scale.std
        self.logger.record_mean("intrinsic/bonus", weight * float(np.mean(np.concatenate(bonuses))))
        self.logger.record("intrinsic/return_std", self.scale.std)
        for name, value in self.novelty.records().items():
            self.logger.record(f"intrinsic/{name}", value)
        return weight


def _arrived_in(run: OptionRun | None, last: Observations) -> Observations:
    """Where the primitive steps of a run led, the last of them to ``last``."""
    if run is None or run.observations is None:
        return last
    return concatenate([take(run.observations, slice(1, None)), last])


def _discounted(run: OptionRun | None, bonuses: FloatArray) -> float:
    """Σ γⁱ bᵢ over the primitive steps of a run."""
    if run is None or len(bonuses) == 1:
        return float(bonuses[0])
    return float(run.gamma ** np.arange(len(bonuses)) @ bonuses)
