"""`MacroQ`: Q-learning and Macro Q-learning over linear features, as a Stable-Baselines3 algorithm."""

from __future__ import annotations

from typing import Any, ClassVar, Self, cast

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean

from sb3_options.linear_features import LinearFeatures, OneHot
from sb3_options.observations import BoolArray, FloatArray, IntArray
from sb3_options.wrapper import OptionsWrapper


class LinearPolicy(BasePolicy):
    """Greedy in Q(s, a) = Σ over active features i of w[i, a].

    Args:
        observation_space: ``Discrete`` or ``Box``.
        action_space: ``Discrete``.
        features: Which features are active.
    """

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Discrete, features: LinearFeatures
    ) -> None:
        super().__init__(observation_space, action_space)
        self.features = features
        weights = torch.zeros(features.n_features, int(action_space.n), dtype=torch.float64)
        self.weights: torch.Tensor
        self.register_buffer("weights", weights)

    def table(self) -> FloatArray:
        """The weights as an array that shares their memory, shape (n_features, n_actions)."""
        return cast("FloatArray", self.weights.numpy())

    def values(self, observations: npt.NDArray[Any]) -> FloatArray:
        """Q of every action, shape (batch, n_actions)."""
        return np.asarray(self.table()[self.features.active(observations)].sum(axis=1))

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        return torch.as_tensor(self.values(np.asarray(observation)).argmax(axis=1))


class MacroQ(BaseAlgorithm):
    """Q-learning (Watkins 1989), and Macro Q-learning once there are options (McGovern & Sutton 1998).

    After a primitive action: Q(s, a) ← Q(s, a) + α [r + γ max Q(s', ·) − Q(s, a)]. After an option of k steps the same
    is done for each primitive step inside it, in order, and then for the option itself with Σ γⁱ rᵢ and γᵏ:
    Q(s, o) ← Q(s, o) + α [Σ γⁱ rᵢ + γᵏ max Q(s', ·) − Q(s, o)]. The maximum is taken over what may start in s'.
    Actions are ε-greedy among what may start, with ties broken at random.

    Args:
        env: With discrete actions; `OptionsWrapper` beneath or not.
        features: Linear features; by default one per state, for ``Discrete`` observations and for one-hot ``Box``.
        learning_rate: α, divided among the active features.
        gamma: γ per primitive step, in [0, 1].
        epsilon: ε, in [0, 1].
        tensorboard_log: Where to log; None does not.
        verbose: As in SB3.
        seed: Of everything random.
        device: Ignored: a table is updated faster by the CPU.
        _init_setup_model: As in SB3.

    Raises:
        ValueError: A value is out of its range, or there are no default features for the observations.
        TypeError: Actions are not discrete.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"LinearPolicy": LinearPolicy}
    policy: LinearPolicy

    def __init__(
        self,
        env: GymEnv | str | None,
        *,
        features: LinearFeatures | None = None,
        learning_rate: float = 0.05,
        gamma: float = 0.9,
        epsilon: float = 0.1,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        policy: type[LinearPolicy] = LinearPolicy,
        _init_setup_model: bool = True,
    ) -> None:
        if not (0.0 <= gamma <= 1.0 and 0.0 <= epsilon <= 1.0 and learning_rate > 0.0):
            raise ValueError(
                f"gamma and epsilon must be in [0, 1] and learning_rate positive, got {gamma}, {epsilon} and "
                f"{learning_rate}."
            )
        super().__init__(
            policy,
            env,
            learning_rate,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device="cpu",
            support_multi_env=True,
            seed=seed,
        )
        self.gamma, self.epsilon, self.features = gamma, epsilon, features
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if not isinstance(self.action_space, spaces.Discrete):
            raise TypeError(f"MacroQ needs a Discrete action space, got {self.action_space}.")
        self.set_random_seed(self.seed)
        self._random = np.random.default_rng(self.seed)
        if self.features is None:
            self.features = default_features(self.observation_space)
        self.policy = LinearPolicy(self.observation_space, self.action_space, self.features)
        self._n_actions = int(self.action_space.n)
        self._n_slots = 0
        if self.env is not None and all(self.env.env_is_wrapped(OptionsWrapper)):
            self._n_slots = self._n_actions - self.env.get_attr("n_primitive", [0])[0]

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str = "MacroQ",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Learn for a number of timesteps.

        Args:
            total_timesteps: How many: primitive steps where a callback of this library is there to count them, and
                decisions otherwise.
            callback: Any SB3 callback or list of them.
            log_interval: Log every so many episodes; None never does.
            tb_log_name: Name of the run for TensorBoard.
            reset_num_timesteps: Start counting from 0.
            progress_bar: Show one.

        Returns:
            The model.
        """
        total_timesteps, callbacks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        assert self.env is not None  # _setup_learn has reset it
        callbacks.on_training_start(locals(), globals())
        callbacks.on_rollout_start()
        assert self.features is not None  # set up with the model
        self._table = self.policy.table()
        has_options = self._n_slots > 0
        masks = self._masks()
        active = self.features.active(cast("npt.NDArray[Any]", self._last_obs))
        while self.num_timesteps < total_timesteps:
            actions = np.array([self._explore(self._values(a), m) for a, m in zip(active, masks, strict=True)])
            new_obs, rewards, dones, infos = self.env.step(actions)
            self.num_timesteps += self.env.num_envs
            callbacks.update_locals(locals())
            if not callbacks.on_step():
                break
            self._update_info_buffer(infos, dones)
            new_active = self.features.active(cast("npt.NDArray[Any]", new_obs))
            for i, info in enumerate(infos):
                arrived = self.features.active(info["terminal_observation"][None])[0] if dones[i] else new_active[i]
                ended = bool(dones[i]) and not info["TimeLimit.truncated"]
                self._learn_from(active[i], int(actions[i]), float(rewards[i]), arrived, ended, info.get("option"))
            self._last_obs, active = new_obs, new_active  # type: ignore[assignment]  # SB3 annotates it as None
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            if dones.any():
                self._episode_num += int(dones.sum())
                masks = self._masks()  # options may have come, and the environment was reset
                if log_interval is not None and self._episode_num % log_interval == 0:
                    self._log()
            elif has_options:
                for i, info in enumerate(infos):
                    if "available" in info["option"]:
                        masks[i, -self._n_slots :] = info["option"]["available"][-1]
        callbacks.on_rollout_end()
        callbacks.on_training_end()
        return self

    def _learn_from(
        self,
        began: IntArray,
        action: int,
        reward: float,
        arrived: IntArray,
        ended: bool,
        option: dict[str, Any] | None,
    ) -> None:
        """Learn from one call of ``step``, and from the primitive steps inside it.

        Args:
            began: Active features where it began, shape (n_active,).
            action: The augmented action.
            reward: Σ γⁱ rᵢ.
            arrived: Active features where it led, shape (n_active,).
            ended: Whether nothing follows.
            option: ``info["option"]``; None where the environment has no options.
        """
        available = None if option is None else option.get("available")
        if option is None or option["index"] < 0:
            if option is not None and "actions" in option:
                action = int(option["actions"][0])  # an empty slot ran this primitive
            self._update(began, action, reward, self.gamma, arrived, ended, None if available is None else available[0])
            return
        assert self.features is not None  # set up with the model
        assert available is not None  # there is an option, so the wrapper says where it may start
        k = option["duration"]
        states = [*self.features.active(option["observations"]), arrived]
        for i, (inner_action, inner_reward) in enumerate(zip(option["actions"], option["rewards"], strict=True)):
            last = ended and i == k - 1
            self._update(states[i], inner_action, inner_reward, self.gamma, states[i + 1], last, available[i])
        self._update(began, action, reward, option["discount"], arrived, ended, available[-1])

    def _update(
        self,
        active: IntArray,
        action: int,
        reward: float,
        discount: float,
        next_active: IntArray,
        ended: bool,
        available: BoolArray | None,
    ) -> None:
        target = reward
        if not ended:
            values = self._values(next_active)
            if self._n_slots:
                n_primitive = len(values) - self._n_slots
                best = values[:n_primitive].max()
                if available is not None and available.any():
                    best = max(best, values[n_primitive:][available].max())
            else:
                best = values.max()
            target += discount * best
        step: float = self.learning_rate / len(active) * (target - self._values(active)[action])  # type: ignore[operator]  # a number, not a schedule
        for index in active:  # an index that hashing gave twice is updated twice
            self._table[index, action] += step

    def _values(self, active: IntArray) -> FloatArray:
        """Q of every action where these features are active, shape (n_actions,)."""
        if len(active) == 1:
            row: FloatArray = self._table[active[0]]
            return row
        return np.asarray(self._table[active].sum(axis=0))

    def _masks(self) -> BoolArray:
        """Which actions may start now in each environment, shape (n_envs, n_actions)."""
        assert self.env is not None  # only asked while learning
        if self._n_slots:
            return np.stack(self.env.env_method("action_masks"))
        return np.ones((self.env.num_envs, self._n_actions), dtype=bool)

    def _explore(self, values: FloatArray, mask: BoolArray) -> int:
        """ε-greedy among the allowed actions, ties broken at random."""
        choices = mask.nonzero()[0]
        if self._random.random() >= self.epsilon:
            allowed = values[choices]
            choices = choices[allowed == allowed.max()]
        return int(choices[0] if len(choices) == 1 else choices[int(self._random.random() * len(choices))])

    def predict(
        self,
        observation: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        state: tuple[npt.NDArray[Any], ...] | None = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: BoolArray | None = None,
    ) -> tuple[npt.NDArray[Any], tuple[npt.NDArray[Any], ...] | None]:
        """Greedy (or ε-greedy) among the available actions.

        Args:
            observation: One, or a batch.
            state: Passed through.
            episode_start: Unused.
            deterministic: Greedy, without ε, the first of several best.
            action_masks: Which actions may be taken; by default asked from the model's own environment.

        Returns:
            Actions and ``state``.
        """
        vectorized = self.policy.is_vectorized_observation(observation)
        batch = np.asarray(observation) if vectorized else np.asarray(observation)[None]
        if action_masks is None:
            action_masks = np.ones((len(batch), self._n_actions), dtype=bool)
            if self._n_slots and self.env is not None:
                action_masks = self.env.env_method("available", batch, indices=[0])[0]
        masks = np.asarray(action_masks, dtype=bool).reshape(len(batch), -1)
        values = self.policy.values(batch)
        if deterministic:
            actions = np.where(masks, values, -np.inf).argmax(axis=1)
        else:
            actions = np.array([self._explore(v, m) for v, m in zip(values, masks, strict=True)])
        return (actions if vectorized else actions[0]), state

    def _log(self) -> None:
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([e["r"] for e in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([e["l"] for e in self.ep_info_buffer]))
        if self.ep_success_buffer:
            self.logger.record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_table"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []


def default_features(space: spaces.Space[Any]) -> LinearFeatures:
    """One feature per state.

    Raises:
        ValueError: The observations are neither ``Discrete`` nor a flat ``Box`` between 0 and 1.
    """
    if isinstance(space, spaces.Discrete):
        return OneHot(int(space.n), coded=False)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and (space.low == 0).all() and (space.high == 1).all():
        return OneHot(space.shape[0], coded=True)
    raise ValueError(
        f"There are no default features for {space}: pass features=TileCoding(low, high, tiles) or "
        "OneHot(n, coded=...)."
    )
