"""`OptionDQN`: DQN that respects initiation sets wherever it chooses an action or takes a maximum."""

import math
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.dqn.policies import DQNPolicy
from torch.nn import functional

from sb3_options.execution.exploration import CappedActions
from sb3_options.experience.observations import BoolArray, FloatArray
from sb3_options.learning.checks import check_gamma, check_wrapped
from sb3_options.learning.families import forget_empty
from sb3_options.learning.masked import MaskedPrediction, n_actions_of, stored_availability
from sb3_options.learning.replay_buffer import OptionReplayBuffer, OptionReplayBufferSamples
from sb3_options.learning.saved_model import put_back

FASTER_WITH_OPTIONS = 4  #: From the first available option on ε falls so many times as fast (docs/studies/deep.md).


class OptionDQN(MaskedPrediction, DQN):
    """DQN whose greedy, ε-random and warm-up actions and bootstrap targets are limited to the available options.

    Stock DQN treats every slot as an action, and its target is a maximum over all of them. Here an option is available
    only in its initiation set, and an empty slot never.

    ``gradient_steps`` and ``target_update_interval`` keep their pace per primitive step: k times the updates follow an
    option of k steps. From the first available option on, ε falls `FASTER_WITH_OPTIONS` times as fast, because options
    explore, too.

    Args:
        policy: As for ``DQN``.
        env: Environment in an `OptionsWrapper`.
        replay_buffer_class: `OptionReplayBuffer` or a subclass.
        n_steps: Decisions of an n-step return.
        **kwargs: As for ``DQN``.

    Raises:
        ValueError: The environment is not wrapped, or the buffer is of another class.
    """

    def __init__(
        self,
        policy: str | type[DQNPolicy],
        env: GymEnv | str | None,
        *,
        replay_buffer_class: type[OptionReplayBuffer] = OptionReplayBuffer,
        n_steps: int = 3,
        **kwargs: Any,
    ) -> None:
        # SB3 hands its own `n_steps` to its own buffers only.
        kwargs["replay_buffer_kwargs"] = {"n_steps": n_steps, **(kwargs.get("replay_buffer_kwargs") or {})}
        super().__init__(policy, env, replay_buffer_class=replay_buffer_class, **kwargs)  # type: ignore[arg-type]  # SB3 passes None when loading
        self._untrained_steps = 0
        self._untrained_decisions = 0
        self._owed = 0.0  # gradient steps still due, if environments wait
        self._waits = False
        self._options_since = math.inf  # primitive steps in `_n_calls` at the first available option

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.env is not None:
            self._track_availability(self.env)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the environment to learn in; it must be wrapped in `OptionsWrapper`, too."""
        super().set_env(env, force_reset)
        self._track_availability(cast("VecEnv", self.env))

    def _track_availability(self, env: VecEnv) -> None:
        check_wrapped(env, "The environment of OptionDQN")
        self._n_slots = n_actions_of(self) - env.get_attr("traits")[0].n_primitive
        self._option_buffer().track_availability(self._n_slots)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        result = super()._setup_learn(*args, **kwargs)
        assert self.env is not None  # it has just been reset
        self._steps_seen = self.num_timesteps
        if self.num_timesteps == 0:  # the schedule of ε starts again
            self._options_since = math.inf
        check_gamma(self, self.env)
        self.env.env_method("set_slots", report_availability=True)
        buffer = self._option_buffer()
        n_primitive = n_actions_of(self) - self._n_slots
        put_back(self, self.env)  # before a slot counts as empty
        for slot in set(range(self._n_slots)) - set(self.env.get_attr("bank", [0])[0].filled):
            forget_empty(self, slot, n_primitive)
        if not buffer.tracks_availability:  # it was loaded after another algorithm had filled it
            buffer.track_availability(self._n_slots)
            if buffer.size():
                available = stored_availability(buffer, self.env)
                buffer.next_available[: buffer.size()] = available[:, n_primitive:]
        return result

    def _option_buffer(self) -> OptionReplayBuffer:
        if not isinstance(self.replay_buffer, OptionReplayBuffer):
            raise ValueError(
                f"OptionDQN needs an OptionReplayBuffer, got {type(self.replay_buffer).__name__}: set "
                "model.replay_buffer to one, or load one that an algorithm with options has saved."
            )
        return self.replay_buffer

    def _action_values(self, observation: Any) -> tuple[FloatArray, bool]:
        self.policy.set_training_mode(False)
        tensor, vectorized = self.policy.obs_to_tensor(observation)
        with torch.no_grad():
            return self.q_net(tensor).cpu().numpy(), vectorized

    def _explored(self, values: FloatArray, masks: BoolArray, greedy: npt.NDArray[Any]) -> npt.NDArray[Any]:
        explores = self.action_space.np_random.random(len(greedy)) < self.exploration_rate
        for i in np.flatnonzero(explores):
            greedy[i] = self._explore(masks[i])
        return greedy

    def _on_step(self) -> None:
        """Update the target network and ε as DQN does, by primitive steps."""
        steps = self.num_timesteps - self._steps_seen
        self._steps_seen = self.num_timesteps
        self._n_calls += steps
        self._untrained_steps += steps
        self._untrained_decisions += self.n_envs
        interval = max(self.target_update_interval // self.n_envs, 1) * self.n_envs
        if self._n_calls // interval > (self._n_calls - steps) // interval:
            polyak_update(self.q_net.parameters(), self.q_net_target.parameters(), self.tau)
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        with_options = FASTER_WITH_OPTIONS * max(self._n_calls - self._options_since, 0) / self._total_timesteps
        self.exploration_rate = min(
            map(self.exploration_schedule, (self._current_progress_remaining, 1 - with_options))
        )
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        masks = np.stack(cast("VecEnv", self.env).env_method("action_masks"))
        if masks[:, masks.shape[1] - self._n_slots :].any():
            self._options_since = min(self._options_since, self._n_calls)
        if self.num_timesteps < learning_starts:
            actions = np.array([self._explore(mask) for mask in masks])
        else:
            actions, _ = self.predict(cast("npt.NDArray[Any]", self._last_obs), action_masks=masks)
        return actions, actions

    def _explore(self, mask: BoolArray) -> int:
        """Draw a random action among those available, (n_actions,)."""
        if isinstance(self.action_space, CappedActions):
            return self.action_space.choose(mask)
        return int(self.action_space.np_random.choice(np.flatnonzero(mask)))

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Update as DQN does per primitive step, with the maximum over available actions."""
        if self._untrained_decisions:
            # While environments wait for options to end, fewer steps than decisions are counted.
            self._waits = self._waits or self._untrained_steps < self._untrained_decisions
            due = gradient_steps * self._untrained_steps / self._untrained_decisions + self._owed
            gradient_steps = round(due)
            self._owed = due - gradient_steps if self._waits else 0.0
            self._untrained_steps = 0
            self._untrained_decisions = 0
            if not gradient_steps:
                return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = []
        for _ in range(gradient_steps):
            samples: OptionReplayBufferSamples = self._option_buffer().sample(batch_size, env=self._vec_normalize_env)
            with torch.no_grad():
                target = smdp_target(self.q_net_target(samples.next_observations), samples)
            current = self.q_net(samples.observations).gather(1, samples.actions)
            loss = functional.smooth_l1_loss(current, target)
            losses.append(loss.item())
            self.policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", float(np.mean(losses)))


def smdp_target(next_values: torch.Tensor, samples: OptionReplayBufferSamples) -> torch.Tensor:
    """Return R + γᵏ max over available a' of Q(s', a'), (batch, 1) (Sutton, Precup & Singh 1999, §3).

    ``next_values`` are Q(s', ·), (batch, n_actions). ``next_available`` covers the last ones: primitives always are.
    """
    if samples.next_available is not None:
        max_options = samples.next_available.shape[1]
        options = next_values[:, next_values.shape[1] - max_options :]
        masked = options.masked_fill(~samples.next_available, -torch.inf)
        next_values = torch.cat([next_values[:, : next_values.shape[1] - max_options], masked], dim=1)
    best = next_values.max(dim=1, keepdim=True).values
    return samples.rewards + (1 - samples.dones) * samples.discounts * best
