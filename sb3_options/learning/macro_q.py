"""`MacroQ`: Q-learning and Macro Q-learning over linear features, as a Stable-Baselines3 algorithm."""

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, Self, cast

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean

from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.experience.observations import BoolArray, FloatArray, IntArray
from sb3_options.experience.option_run import OptionRun
from sb3_options.learning.masked import MaskedPrediction, n_actions_of

LONGEST_ROLLOUT = 1000
"""Decisions of each environment after which a rollout ends even if no episode has, as in tasks without episodes."""


class LinearFeatures(Protocol):
    """Says which of ``n_features`` binary features are 1 in an observation; always ``n_active`` of them."""

    n_features: int
    n_active: int

    def active(self, observations: npt.NDArray[Any]) -> IntArray:
        """Return the indices of the features that are 1, for a batch of observations: shape (batch, n_active)."""


class OneHot:
    """One feature per state: a linear value function over it is a table.

    Args:
        n_features: Number of states.
        coded: Whether observations are one-hot vectors (batch, n_features) rather than indices (batch,).
    """

    n_active = 1

    def __init__(self, n_features: int, *, coded: bool) -> None:
        self.n_features = n_features
        self.coded = coded

    def active(self, observations: npt.NDArray[Any]) -> IntArray:
        """Return the state's index, shape (batch, 1)."""
        if self.coded:
            index: IntArray = observations.reshape(-1, self.n_features).argmax(axis=1, keepdims=True)
            return index
        return observations.reshape(-1, 1).astype(np.int64)


class LinearPolicy(BasePolicy):
    """Greedy in Q(s, a) = Σ over active features i of w[i, a]."""

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Discrete, features: LinearFeatures
    ) -> None:
        super().__init__(observation_space, action_space)
        self.features = features
        weights = torch.zeros(features.n_features, int(action_space.n), dtype=torch.float64)
        self.weights: torch.Tensor
        self.register_buffer("weights", weights)

    def table(self) -> FloatArray:
        """Return the weights as an array that shares their memory, shape (n_features, n_actions)."""
        return cast("FloatArray", self.weights.numpy())

    def values(self, observations: npt.NDArray[Any]) -> FloatArray:
        """Return Q of every action, shape (batch, n_actions)."""
        return np.asarray(self.table()[self.features.active(observations)].sum(axis=1))

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        return torch.as_tensor(self.values(np.asarray(observation)).argmax(axis=1))


class MacroQ(MaskedPrediction):
    """Q-learning (Watkins 1989), and Macro Q-learning once there are options (McGovern & Sutton 1998).

    After a primitive action: Q(s, a) ← Q(s, a) + α [r + γ max Q(s', ·) − Q(s, a)]. After an option of k steps the same
    is done for each primitive step inside it, in order, and then for the option itself with Σ γⁱ rᵢ and γᵏ:
    Q(s, o) ← Q(s, o) + α [Σ γⁱ rᵢ + γᵏ max Q(s', ·) − Q(s, o)]. The maximum is over the actions that may start in s'.
    An action with a duration of its own (``info["option"]`` of a user's environment) is discounted by its γᵏ, too.
    Actions are ε-greedy among those that may start, with ties broken at random.

    Args:
        env: Environment with discrete actions, with or without `OptionsWrapper`.
        features: Linear features; by default one per state, for ``Discrete`` observations and for one-hot ``Box``.
        learning_rate: α, divided among the active features.
        gamma: γ per primitive step, in [0, 1].
        epsilon: ε, in [0, 1].
        tensorboard_log: Folder of the TensorBoard log; None writes none.
        verbose: As in SB3.
        seed: Seed of everything random.
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
        self.gamma = gamma
        self.epsilon = epsilon
        self.features = features
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
        self._n_actions = n_actions_of(self)
        self._count_slots()

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Learn in another environment from now on, as in SB3."""
        super().set_env(env, force_reset)
        self._count_slots()

    def _count_slots(self) -> None:
        self._n_primitive = self._n_actions
        if self.env is not None and all(self.env.env_is_wrapped(OptionsWrapper)):
            self._n_primitive = self.env.get_attr("traits")[0].n_primitive
            self.env.env_method("set_slots", report_availability=True)
        self._n_slots = self._n_actions - self._n_primitive
        self._primitives = list(range(self._n_primitive))

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str = "MacroQ",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Learn for a number of timesteps; arguments and result are as in SB3.

        ``total_timesteps`` are primitive steps if a callback of this library counts them, else decisions. There are
        ``log_interval`` episodes between two entries of the log; None writes none.
        """
        # Callbacks find each other in the local `callback`, as with SB3's own algorithms.
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        assert self.env is not None  # _setup_learn has reset it
        assert self.features is not None  # set up with the model
        callback.on_training_start(locals(), globals())
        callback.on_rollout_start()
        self._table = self.policy.table()
        self._step_size = cast("float", self.learning_rate)  # the constructor takes no schedule
        choices = self._choices()
        self._asks = self._n_slots > 0 and any(each.masks_primitives for each in self.env.get_attr("traits"))
        active = self._active(self._last_obs)
        goes_on = True
        since = 0
        while goes_on and self.num_timesteps < total_timesteps:
            actions = np.array([self._explore(self._values(a), c) for a, c in zip(active, choices, strict=True)])
            new_obs, rewards, dones, infos = self.env.step(actions)
            self.num_timesteps += self.env.num_envs
            new_active = self._active(new_obs)
            over: list[bool] = dones.tolist()
            runs = [OptionRun.from_info(info) if "option" in info else None for info in infos]
            for i, info in enumerate(infos):
                arrived = self._active(np.asarray(info["terminal_observation"])[None])[0] if over[i] else new_active[i]
                ended = over[i] and not info.get("TimeLimit.truncated", False)
                self._learn_from(active[i], int(actions[i]), float(rewards[i]), arrived, ended, runs[i])
            self._last_obs, active = new_obs, new_active  # type: ignore[assignment]  # SB3 annotates it as None
            # After the update: a callback that stops training at the end of an episode must lose no step.
            callback.update_locals(locals())
            goes_on = callback.on_step()
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            since += 1
            if any(over) or since == LONGEST_ROLLOUT:
                since = 0
                self._update_info_buffer(infos, dones)
                self._episode_num += sum(over)
                # Between two rollouts callbacks install and remove options, and write checkpoints. Here a rollout
                # lasts until an episode ends, which may never happen.
                callback.on_rollout_end()
                if log_interval is not None and any(over) and self._episode_num % log_interval == 0:
                    self._log()  # before a checkpoint: a resumed training logs nothing older
                callback.on_rollout_start()
                choices = self._choices()
            elif self._asks:
                choices = self._choices()
            elif self._n_slots:
                choices = [self._choices_after(run) for run in runs]
        callback.on_rollout_end()
        callback.on_training_end()
        return self

    def _learn_from(
        self,
        began: list[int],
        action: int,
        reward: float,
        arrived: list[int],
        ended: bool,
        run: OptionRun | None,
    ) -> None:
        """Update the values from one call of ``step`` and from the primitive steps inside it.

        ``began`` and ``arrived`` are the active features before and after. Without options there is no ``run``.
        """
        if run is None:
            self._update(began, action, reward, self.gamma, arrived, ended, ())
            return
        if run.termination == "running":  # its environment waits, or its slot was emptied
            return
        if run.index < 0:
            if run.actions is not None:
                action = int(run.actions[0])  # an empty slot ran this primitive
            may_start = () if run.available is None else run.available[0].tolist()
            self._update(began, action, reward, run.discount, arrived, ended, may_start)
            return
        action = self._n_primitive + run.index
        assert run.actions is not None  # an option reports its steps
        assert run.rewards is not None
        available = [()] * run.duration if run.available is None else run.available.tolist()
        states = [*self._active(run.observations), arrived]
        steps = zip(run.actions.tolist(), run.rewards.tolist(), strict=True)
        for i, (inner_action, inner_reward) in enumerate(steps):
            last = ended and i == run.duration - 1
            self._update(states[i], inner_action, inner_reward, self.gamma, states[i + 1], last, available[i])
        self._update(began, action, reward, run.discount, arrived, ended, available[-1])

    def _update(
        self,
        active: list[int],
        action: int,
        reward: float,
        discount: float,
        next_active: list[int],
        ended: bool,
        available: Sequence[bool],
    ) -> None:
        """Set Q ← Q + α [r + γᵏ max Q(s', ·) − Q], the maximum over primitives and the ``available`` slots."""
        target = reward
        if not ended:
            values = self._values(next_active)
            best = max(values[: self._n_primitive])
            for value, may_start in zip(values[self._n_primitive :], available, strict=False):
                if may_start and value > best:
                    best = value
            target += discount * best
        step = self._step_size / len(active) * (target - self._values(active)[action])
        for index in active:  # faster than an array for so few indices
            self._table[index, action] += step

    def _active(self, observations: Any) -> list[list[int]]:
        """Return the active features of a batch as lists: for a handful of numbers Python is faster than numpy."""
        assert self.features is not None  # set up with the model
        indices: list[list[int]] = self.features.active(observations).tolist()
        return indices

    def _values(self, active: list[int]) -> list[float]:
        """Return Q of every action for these active features."""
        row = self._table[active[0]] if len(active) == 1 else self._table[active].sum(axis=0)
        values: list[float] = row.tolist()
        return values

    def _choices(self) -> list[list[int]]:
        """Ask each environment which actions may start now."""
        assert self.env is not None  # only asked while learning
        if self._n_slots:
            return [mask.nonzero()[0].tolist() for mask in self.env.env_method("action_masks")]
        return [list(range(self._n_actions))] * self.env.num_envs

    def _choices_after(self, run: OptionRun | None) -> list[int]:
        """Return which actions may start after a run."""
        if run is None or run.available is None:
            return self._primitives
        slots: list[bool] = run.available[-1].tolist()
        return self._primitives + [self._n_primitive + slot for slot, may_start in enumerate(slots) if may_start]

    def _explore(self, values: list[float], choices: list[int]) -> int:
        """Choose ε-greedily among ``choices``, with ties broken at random."""
        if self._random.random() >= self.epsilon:
            best = max(values) if len(choices) == len(values) else max([values[a] for a in choices])
            choices = [a for a in choices if values[a] == best]
        return choices[0] if len(choices) == 1 else choices[int(self._random.random() * len(choices))]

    def _action_values(self, observation: Any) -> tuple[FloatArray, bool]:
        vectorized = self.policy.is_vectorized_observation(observation)
        return self.policy.values(np.asarray(observation) if vectorized else np.asarray(observation)[None]), vectorized

    def _explored(self, values: FloatArray, masks: BoolArray, greedy: npt.NDArray[Any]) -> npt.NDArray[Any]:
        choices = [mask.nonzero()[0].tolist() for mask in masks]
        return np.array([self._explore(v, c) for v, c in zip(values.tolist(), choices, strict=True)])

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
    """Return one feature per state."""
    if isinstance(space, spaces.Discrete):
        return OneHot(int(space.n), coded=False)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and (space.low == 0).all() and (space.high == 1).all():
        return OneHot(space.shape[0], coded=True)
    raise ValueError(
        f"There are no default features for {space}: pass features=OneHot(n, coded=...), or your own LinearFeatures."
    )
