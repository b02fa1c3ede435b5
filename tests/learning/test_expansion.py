"""A model that was trained without options, and what of it is still the same once it has slots."""

from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize, VecTransposeImage

from sb3_options import OptionReplayBuffer, OptionsWrapper, expand_action_space
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.learning import heads
from sb3_options.learning.joined_linear import JoinedLinear, by_action
from sb3_options.learning.rollout_buffer import SMDPAdvantages
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import (
    DOORWAY,
    RANDOM,
    TINY,
    Corridor,
    env_of,
    fast_callback,
    make_optioned_rooms,
    n_actions_of,
    optioned_rooms,
    places,
    small_rooms,
)

N_PRIMITIVE, MAX_OPTIONS = 4, 3
N_ACTIONS = N_PRIMITIVE + MAX_OPTIONS
N_QUANTILES = 7
GAMMA = 0.9

OFF_POLICY: dict[str, Any] = {"learning_starts": 50, "buffer_size": 1000, "target_update_interval": 50}
ON_POLICY: dict[str, Any] = {"n_steps": 64, "device": "cpu"}


class Kind(NamedTuple):
    """An algorithm, small enough for tests."""

    algorithm: Any
    policy: str
    kwargs: dict[str, Any]


KINDS = {
    "dqn": Kind(DQN, "MlpPolicy", OFF_POLICY),
    "qrdqn": Kind(QRDQN, "MlpPolicy", {**OFF_POLICY, "policy_kwargs": {"n_quantiles": N_QUANTILES}}),
    "ppo": Kind(PPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32, "n_epochs": 2}),
    "a2c": Kind(A2C, "MlpPolicy", ON_POLICY),
    "trpo": Kind(TRPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32}),
    "maskableppo": Kind(MaskablePPO, "MlpPolicy", {**ON_POLICY, "batch_size": 32, "n_epochs": 2}),
    "recurrentppo": Kind(
        RecurrentPPO,
        "MlpLstmPolicy",
        {**ON_POLICY, "batch_size": 64, "n_epochs": 2, "policy_kwargs": {"lstm_hidden_size": 16}},
    ),
}
every = pytest.mark.parametrize("name", list(KINDS))
every_and_a_size_that_matters = pytest.mark.parametrize(
    # 7 quantiles of 4 + 1 actions: here a plain wider layer says something else in the last bit.
    ("name", "max_options"),
    [*((name, MAX_OPTIONS) for name in KINDS), ("qrdqn", 1)],
)
off_policy = pytest.mark.parametrize("name", ["dqn", "qrdqn"])


def trained(name: str, env: Any = None, steps: int = 128, **kwargs: Any) -> Any:
    """A model of its own that has learned a little; the same every time."""
    kind = KINDS[name]
    env = make_vec_env(small_rooms, 1, seed=0) if env is None else env
    model = kind.algorithm(kind.policy, env, gamma=GAMMA, seed=0, **{**kind.kwargs, **kwargs})
    masking = {"use_masking": False} if name == "maskableppo" else {}
    return model.learn(steps, **masking)


def outputs(model: Any, observations: Any) -> list[torch.Tensor]:
    """What the last layers say, online and target, as they stand in the policy: (batch, outputs an action, actions)."""
    said: list[torch.Tensor] = []
    hooks = [
        layer.register_forward_hook(
            lambda _, __, y, n=per_action: said.append(y.detach().clone().unflatten(-1, (n, -1)))
        )
        for layer, per_action in heads.option_outputs(model.policy)
    ]
    model.predict(observations, deterministic=True)
    for network in ("q_net_target", "quantile_net_target"):
        if hasattr(model.policy, network):
            with torch.no_grad():
                getattr(model.policy, network)(model.policy.obs_to_tensor(observations)[0])
    for hook in hooks:
        hook.remove()
    return said


def random_observations(model: BaseAlgorithm, n: int) -> npt.NDArray[Any]:
    return np.random.default_rng(n).random((n, *cast("Any", model.observation_space.shape))).astype(np.float32)


def old_rows(rows: torch.Tensor, outputs_per_action: int, n_later: int = MAX_OPTIONS) -> torch.Tensor:
    return by_action(rows, outputs_per_action)[:, :-n_later].flatten(0, 1)


def weights_of_old(model: Any, stock: Any) -> list[tuple[str, torch.Tensor, torch.Tensor]]:
    """Every parameter of both, without the rows of slots."""
    per_action = N_QUANTILES if isinstance(model, QRDQN) else 1
    before, after = stock.policy.state_dict(), model.policy.state_dict()
    assert list(before) == list(after)
    return [
        (key, old, new if new.shape == old.shape else old_rows(new, per_action))
        for (key, old), new in zip(before.items(), after.values(), strict=True)
    ]


@every_and_a_size_that_matters
def test_outputs_for_old_actions_are_bit_identical(name: str, max_options: int) -> None:
    model = trained(name)
    batches = [random_observations(model, n) for n in (1, 3, 64)]
    before = [outputs(model, batch) for batch in batches]
    chosen = [model.predict(batch, deterministic=True)[0] for batch in batches]
    assert expand_action_space(model, max_options) is model
    for opened in (None, *range(max_options)):
        if opened is not None:
            heads.open_head(model.policy, N_PRIMITIVE + opened, N_PRIMITIVE)
        for batch, old in zip(batches, before, strict=True):
            new = outputs(model, batch)
            assert len(old) == len(new) == (2 if name in ("dqn", "qrdqn") else 1)
            for a, b in zip(old, new, strict=True):
                assert b.shape[-1] == N_PRIMITIVE + max_options
                assert torch.equal(a, b[..., :N_PRIMITIVE])
        if opened is None:
            assert all(heads.is_closed(model.policy, N_PRIMITIVE + i) for i in range(max_options))
            for batch, actions in zip(batches, chosen, strict=True):
                assert np.array_equal(actions, model.predict(batch, deterministic=True)[0])


@pytest.mark.parametrize("name", ["dqn", "ppo"])
@pytest.mark.parametrize("kind", ["box", "discrete", "dict", "dict_discrete", "image"])
def test_every_kind_of_observation(name: str, kind: str) -> None:
    algorithm = KINDS[name].algorithm
    policy = {"image": "CnnPolicy", "dict": "MultiInputPolicy", "dict_discrete": "MultiInputPolicy"}
    kwargs = {**KINDS[name].kwargs, "batch_size": 16, **({"n_epochs": 1} if name == "ppo" else {"buffer_size": 100})}
    model = algorithm(policy.get(kind, "MlpPolicy"), Corridor(kind), gamma=GAMMA, seed=0, **kwargs).learn(64)
    seen = env_of(model).reset()
    before = outputs(model, seen)
    expand_action_space(model, 2, feature_map=places)
    after = outputs(model, seen)
    assert all(torch.equal(a, b[..., :2]) for a, b in zip(before, after, strict=True))
    assert is_transposed(model) == (kind in ("image", "dict"))
    callback = SubgoalDiscoveryCallback()
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == 128
    assert callback.episodes > 0
    if name == "dqn":
        assert model.replay_buffer.size() == 100
        assert (model.replay_buffer.sample(16).discounts == GAMMA).all()


def is_transposed(model: BaseAlgorithm) -> bool:
    return isinstance(env_of(model), VecTransposeImage)


@every
def test_training_goes_on_as_it_would_have(name: str) -> None:
    """The same batches, without options: old weights stay equal bit for bit, but for TRPO.

    TRPO's step solves a linear system by conjugate gradients whose sums run over the new actions as well.
    """
    unclipped: dict[str, Any] = (
        {} if name == "trpo" else {"max_grad_norm": 1e9}
    )  # a norm over more numbers rounds otherwise
    stock, model = (trained(name, **unclipped) for _ in range(2))
    rollout = dict(vars(stock.rollout_buffer)) if hasattr(stock, "rollout_buffer") else {}
    expand_action_space(model, MAX_OPTIONS)
    if name == "maskableppo":  # its masks are wider now; what else was collected goes in again
        masks = np.pad(rollout["action_masks"], [(0, 0)] * (rollout["action_masks"].ndim - 1) + [(0, MAX_OPTIONS)])
        kept = {k: v for k, v in rollout.items() if k not in ("action_space", "mask_dims")}
        vars(model.rollout_buffer).update({**kept, "action_masks": masks})
    learned = [old.clone() for _, old, _ in weights_of_old(model, stock)]
    for each in (stock, model):
        set_random_seed(3)
        if name in ("dqn", "qrdqn"):
            each.train(100, 32)
        else:
            each.train()
    for key, old, new in weights_of_old(model, stock):
        if name == "trpo":
            torch.testing.assert_close(old, new, rtol=0, atol=1e-5)
        else:
            assert torch.equal(old, new), key
    assert any(not torch.equal(a, old) for a, (_, old, _) in zip(learned, weights_of_old(model, stock), strict=True))
    assert all(heads.is_closed(model.policy, N_PRIMITIVE + i) for i in range(MAX_OPTIONS))
    assert stock._n_updates == model._n_updates


@every
def test_optimizer_and_counters_are_kept(name: str) -> None:
    stock, model = (trained(name, steps=256) for _ in range(2))
    groups, schedule, step = [*model.policy.optimizer.param_groups], model.lr_schedule, model.num_timesteps
    expand_action_space(model, MAX_OPTIONS)
    assert model.num_timesteps == step == 256
    assert model._n_updates == stock._n_updates > 0
    assert model.lr_schedule is schedule
    assert [e["l"] for e in model.ep_info_buffer] == [e["l"] for e in stock.ep_info_buffer] != []
    assert all(a is b for a, b in zip(groups, model.policy.optimizer.param_groups, strict=True))
    if name in ("dqn", "qrdqn"):
        assert model.exploration_rate == stock.exploration_rate
        assert model.exploration_schedule(0.97) == stock.exploration_schedule(0.97)
    per_action = N_QUANTILES if name == "qrdqn" else 1
    online = dict(model.policy.named_parameters())
    states = stock.policy.optimizer.state
    named = [(key, p, online[key]) for key, p in stock.policy.named_parameters() if p in states]
    assert len(states) == len(model.policy.optimizer.state) == len(named) > 0
    for key, old, new in named:
        for moment, value in states[old].items():
            other = model.policy.optimizer.state[new][moment]
            if torch.is_tensor(value) and value.shape == old.shape != new.shape:
                assert (by_action(other, per_action)[:, N_PRIMITIVE:] == 0).all()
                other = old_rows(other, per_action)
            assert torch.equal(torch.as_tensor(value), torch.as_tensor(other)), (key, moment)


@every
def test_everything_knows_the_new_actions(name: str) -> None:
    model = trained(name, steps=128)
    random = model.action_space.np_random
    expand_action_space(model, MAX_OPTIONS)
    expected = spaces.Discrete(N_ACTIONS)
    assert model.action_space == model.policy.action_space == env_of(model).action_space == expected
    assert model.action_space.np_random is random
    for network in ("q_net", "q_net_target", "quantile_net", "quantile_net_target"):
        if hasattr(model, network):
            assert getattr(model, network) is getattr(model.policy, network)
            assert getattr(model, network).action_space == expected
    buffer = model.replay_buffer if name in ("dqn", "qrdqn") else model.rollout_buffer
    assert buffer.action_space == expected
    for layer, per_action in heads.option_outputs(model.policy):
        assert isinstance(layer, JoinedLinear)
        assert (layer.n_first, layer.outputs_per_action) == (N_PRIMITIVE, per_action)
        assert layer.weight.shape[0] == N_ACTIONS * per_action
    if name not in ("dqn", "qrdqn"):
        assert model.policy.action_dist.action_dim == N_ACTIONS
    if name == "maskableppo":
        assert buffer.action_masks.shape[-1] == N_ACTIONS


@off_policy
@pytest.mark.parametrize("n_envs", [1, 3])
def test_replay_data_is_kept(name: str, n_envs: int) -> None:
    model = trained(name, make_vec_env(small_rooms, n_envs, seed=0), steps=600, buffer_size=300)
    stock = model.replay_buffer
    rewards, actions = stock.rewards.copy(), stock.actions.copy()
    expand_action_space(model, MAX_OPTIONS)
    buffer = model.replay_buffer
    assert isinstance(buffer, OptionReplayBuffer)
    assert buffer.full
    assert buffer.buffer_size == 300
    assert np.array_equal(buffer.rewards, rewards.ravel())
    assert np.array_equal(buffer.actions[:, 0], actions.ravel())
    assert (buffer.discounts == np.float32(GAMMA)).all()
    model.learn(60, reset_num_timesteps=False)
    assert set(buffer.actions[:, 0]) <= set(range(N_PRIMITIVE))


def test_n_step_returns_go_on() -> None:
    model = trained("dqn", steps=128, n_steps=3)
    expand_action_space(model, MAX_OPTIONS)
    assert model.replay_buffer.n_steps == 3
    model.learn(60, reset_num_timesteps=False, callback=PrimitiveStepsCallback())
    assert model.replay_buffer.size() > 128


@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")  # SB3 says so of its own buffer
def test_n_step_returns_of_a_model_that_was_loaded(tmp_path: Path) -> None:
    """SB3 saves no replay buffer."""
    trained("dqn", steps=128, n_steps=3).save(tmp_path / "model.zip")
    model = expand_action_space(DQN.load(tmp_path / "model.zip", env=small_rooms()), MAX_OPTIONS)
    model.learn(60, reset_num_timesteps=False, callback=PrimitiveStepsCallback())
    assert cast("Any", model.replay_buffer).n_steps == 3


def test_a_buffer_that_was_taken_away_or_knows_options_already() -> None:
    model = trained("dqn", steps=64)
    model.replay_buffer = None
    expand_action_space(model, MAX_OPTIONS)
    assert model.replay_buffer.size() == 0
    assert model.replay_buffer.buffer_size == 1000
    other = DQN("MlpPolicy", small_rooms(), gamma=GAMMA, replay_buffer_class=OptionReplayBuffer, buffer_size=50)
    mine = other.replay_buffer
    expand_action_space(other, MAX_OPTIONS)
    assert other.replay_buffer is mine
    other.learn(10)


def test_environments_are_wrapped_beneath_whatever_stands_above() -> None:
    venv = VecNormalize(make_vec_env(small_rooms, 2, seed=0), gamma=GAMMA, clip_reward=np.inf)
    model = trained("dqn", venv, steps=256)
    count = cast("Any", venv.obs_rms).count
    expand_action_space(model, MAX_OPTIONS)
    assert env_of(model) is venv
    assert model.get_vec_normalize_env() is venv
    assert cast("Any", venv.obs_rms).count == count
    assert n_actions_of(model) == venv.action_space.n == N_ACTIONS
    for env in cast("DummyVecEnv", venv.unwrapped).envs:
        assert isinstance(env, OptionsWrapper)
        assert isinstance(env.env, Monitor)
        assert env.gamma == GAMMA
    model.learn(300, callback=fast_callback(), reset_num_timesteps=False)
    assert model.num_timesteps == 256 + 304  # whole train_freq's of 2 environments


@every_and_a_size_that_matters
def test_saved_and_loaded(name: str, max_options: int, tmp_path: Path) -> None:
    model = expand_action_space(trained(name), max_options)
    heads.open_head(model.policy, N_PRIMITIVE, N_PRIMITIVE)
    batches = [random_observations(model, n) for n in (1, 3, 64)]
    model.save(tmp_path / "model.zip")
    loaded = type(model).load(tmp_path / "model.zip", device="cpu")
    for batch in batches:
        for a, b in zip(outputs(model, batch), outputs(loaded, batch), strict=True):
            assert torch.equal(a, b)
    assert loaded.action_space == model.action_space
    env = make_vec_env(optioned_rooms, 1, env_kwargs={"max_options": max_options}, seed=0)
    again = type(model).load(tmp_path / "model.zip", env=env, device="cpu")
    kept, loaded_state = (m.policy.optimizer.state_dict()["state"] for m in (model, again))
    assert len(kept) == len(loaded_state) > 0
    for key, state in kept.items():
        for moment, value in state.items():
            assert torch.equal(torch.as_tensor(value), torch.as_tensor(loaded_state[key][moment]))
    again.save(tmp_path / "again.zip")
    plain = KINDS[name].algorithm(KINDS[name].policy, env, gamma=GAMMA, **KINDS[name].kwargs)
    plain.set_parameters(tmp_path / "again.zip", device="cpu")  # how train.py's evaluate reads weights
    for a, b in zip(outputs(model, batches[1]), outputs(plain, batches[1]), strict=True):
        torch.testing.assert_close(a, b)


def test_dqn_discovers_after_it_was_expanded() -> None:
    """Of seeds 10 to 49, 27 find a place within one cell of the doorway; of models built with slots, 30."""
    model = DQN("MlpPolicy", small_rooms(), gamma=GAMMA, **{**TINY, "seed": 1}, **RANDOM)
    model.learn(1008)  # a multiple of train_freq
    expand_action_space(model, MAX_OPTIONS)
    assert model.replay_buffer is not None
    assert model.replay_buffer.size() == 1008
    callback = fast_callback()
    model.learn(4000, callback=callback, reset_num_timesteps=False)
    assert len(callback.discoveries) == 1
    assert np.abs(callback.discoveries[0].subgoal - DOORWAY).max() <= 1
    assert not heads.is_closed(model.policy, N_PRIMITIVE)
    assert heads.is_closed(model.policy, N_PRIMITIVE + 1)
    buffer = cast("OptionReplayBuffer", model.replay_buffer)
    actions, discounts = buffer.actions[: buffer.size(), 0], buffer.discounts[: buffer.size()]
    assert set(actions) == set(range(N_PRIMITIVE + 1))
    assert discounts[actions == N_PRIMITIVE].min() < GAMMA**2
    assert model.num_timesteps >= 5000


@pytest.mark.parametrize(
    "name", ["ppo", "a2c", "trpo", "maskableppo", pytest.param("recurrentppo", marks=pytest.mark.slow)]
)
def test_on_policy_algorithms_discover_after_they_were_expanded(name: str) -> None:
    kwargs: dict[str, Any] = {} if name in ("a2c", "trpo") else {"n_epochs": 1}
    if name in ("ppo", "a2c"):
        kwargs["ent_coef"] = 0.5
    model = trained(name, steps=256, **kwargs)
    expand_action_space(model, MAX_OPTIONS)
    callback = fast_callback()
    steps = 0
    while not callback.discoveries and steps < 10:
        model.learn(1000, callback=callback, reset_num_timesteps=False)
        steps += 1
    assert len(callback.discoveries) == 1
    assert np.abs(callback.discoveries[0].subgoal - DOORWAY).max() <= 1
    chosen = False
    while not chosen and steps < 30:
        model.learn(256, callback=callback, reset_num_timesteps=False)
        chosen = N_PRIMITIVE in cast("Any", model.rollout_buffer).actions
        steps += 1
    assert chosen
    assert not heads.is_closed(model.policy, N_PRIMITIVE)
    assert heads.is_closed(model.policy, N_PRIMITIVE + 1)
    assert isinstance(model.rollout_buffer, SMDPAdvantages)


def test_masks_of_the_environment_itself_go_on() -> None:
    class Masked(Corridor):
        def action_masks(self) -> list[bool]:
            return [self.place > 0, True]

        def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            assert action == 1 or self.place > 0
            return super().step(action)

    kwargs = {**KINDS["maskableppo"].kwargs, "n_epochs": 1}
    model = MaskablePPO("MlpPolicy", Masked(), gamma=GAMMA, seed=0, **kwargs).learn(128)
    expand_action_space(model, 2)
    model.learn(256, callback=SubgoalDiscoveryCallback(max_new_options=0), reset_num_timesteps=False)
    masks = model.rollout_buffer.action_masks.reshape(-1, 4)
    assert not masks[:, 0].all()
    assert masks[:, 1].all()
    assert not masks[:, 2:].any()


def test_worker_processes_and_a_model_without_environment(tmp_path: Path) -> None:
    trained("dqn", steps=64).save(tmp_path / "model.zip")
    model = DQN.load(tmp_path / "model.zip")
    batch = random_observations(model, 3)
    before = outputs(model, batch)
    with pytest.raises(ValueError, match=r"model has no environment: give one to DQN.load\(..., env=...\), or pass "):
        expand_action_space(model, 4)
    workers = SubprocVecEnv([make_optioned_rooms])
    try:
        expand_action_space(model, 4, env=workers)
        assert env_of(model) is workers
        for a, b in zip(before, outputs(model, batch), strict=True):
            assert torch.equal(a, b[..., :N_PRIMITIVE])
        model.learn(64, callback=fast_callback(), reset_num_timesteps=False)
        assert model.num_timesteps == 128
    finally:
        workers.close()


def test_another_environment_takes_the_place_of_the_models(capsys: pytest.CaptureFixture[str]) -> None:
    model = trained("dqn", steps=64)
    model.verbose = 1
    other = optioned_rooms(2)
    expand_action_space(model, 2, env=other)
    assert "Wrapping the env in a DummyVecEnv." in capsys.readouterr().out
    model.verbose = 0
    model.learn(64, callback=fast_callback(), reset_num_timesteps=False)
    (env,) = cast("DummyVecEnv", env_of(model)).envs
    assert isinstance(env, Monitor)
    assert env.env is other
    assert n_actions_of(model) == N_PRIMITIVE + 2


def bare_workers() -> Any:
    return small_rooms()


def test_bare_worker_processes_are_refused() -> None:
    workers = SubprocVecEnv([bare_workers])
    try:
        model = DQN("MlpPolicy", workers, buffer_size=10)
        with pytest.raises(
            ValueError, match=r"of a SubprocVecEnv cannot be wrapped from here: pass env=.*gamma\": 0.99"
        ):
            expand_action_space(model)
    finally:
        workers.close()


def small_model(**kwargs: Any) -> Any:
    return DQN("MlpPolicy", small_rooms(), **{"gamma": GAMMA, "buffer_size": 10, **kwargs})


def test_errors_leave_the_model_as_it_was() -> None:
    model = small_model()
    weights = {key: value.clone() for key, value in model.policy.state_dict().items()}
    smaller = {"map": "SSS.\n...G", "max_steps": 9}
    with pytest.raises(ValueError, match="max_options must be at least 1, got 0"):
        expand_action_space(model, 0)
    with pytest.raises(
        ValueError, match=r"env is not wrapped in OptionsWrapper: use OptionsWrapper\(env, max_options=4, gamma=0.9"
    ):
        expand_action_space(model, env=small_rooms())
    with pytest.raises(ValueError, match="env has 4 option slots, max_options is 3: give both the same"):
        expand_action_space(model, 3, env=optioned_rooms(4))
    with pytest.raises(ValueError, match=r"OptionsWrapper discounts with gamma=0.5, DQN with gamma=0.9"):
        expand_action_space(model, 4, env=OptionsWrapper(small_rooms(), 4, gamma=0.5))
    with pytest.raises(ValueError, match=r"chooses among 4 actions, env has 2 primitive actions"):
        expand_action_space(model, 4, env=OptionsWrapper(Corridor(), 4, gamma=GAMMA))
    with pytest.raises(ValueError, match=r"trained on observations Box.*\(45,\).*, env has Box.*\(8,\)"):
        expand_action_space(model, 4, env=optioned_rooms(4, **smaller))
    with pytest.raises(ValueError, match=r"trained with n_envs=1, env has 2: .* DQN.load"):
        expand_action_space(model, 4, env=make_vec_env(optioned_rooms, 2))
    with pytest.raises(ValueError, match=r"feature_map belongs to OptionsWrapper: with env=... pass it"):
        expand_action_space(model, 4, env=optioned_rooms(4), feature_map=places)
    with pytest.raises(TypeError, match="feature_map must be"):
        expand_action_space(model, 4, feature_map=cast("Any", 3))
    assert n_actions_of(model) == N_PRIMITIVE
    assert not any(env_of(model).env_is_wrapped(OptionsWrapper))
    assert type(model.replay_buffer) is ReplayBuffer
    assert all(torch.equal(weights[key], value) for key, value in model.policy.state_dict().items())
    model.learn(20)


def test_slots_cannot_be_added_twice() -> None:
    model = expand_action_space(small_model(), 2)
    with pytest.raises(ValueError, match=r"is wrapped in OptionsWrapper already: among its 6 actions are option slots"):
        expand_action_space(model, 2)


def test_other_models_are_refused() -> None:
    class Continuous(Corridor):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = spaces.Box(-1.0, 1.0, (1,))

    with pytest.raises(TypeError, match=r"whose actions are Discrete and start at 0, got Box\(-1.0, 1.0, \(1,\)"):
        expand_action_space(PPO("MlpPolicy", Continuous(), n_steps=8, batch_size=8, device="cpu"))
    model = small_model()
    model.policy.q_net.q_net.append(torch.nn.Tanh())
    with pytest.raises(TypeError, match="The last layer of QNetwork is Tanh"):
        expand_action_space(model)
    model = small_model()
    model.policy.q_net_target = None
    with pytest.raises(TypeError, match="heads of DQNPolicy are not known"):
        expand_action_space(model)

    class Own(ReplayBuffer):
        pass

    with pytest.raises(TypeError, match="transitions of a Own cannot be taken over"):
        expand_action_space(small_model(replay_buffer_class=Own))


def test_one_seed_one_result() -> None:
    """What empty slots draw is seeded by the model, for each environment apart."""
    draws = []
    for _ in range(2):
        model = DQN("MlpPolicy", make_vec_env(small_rooms, 2, seed=0), gamma=GAMMA, seed=0, buffer_size=200, **RANDOM)
        expand_action_space(model.learn(50), MAX_OPTIONS)
        model.learn(100, reset_num_timesteps=False)
        draws.append(cast("OptionReplayBuffer", model.replay_buffer).actions[:, 0].copy())
        inner = cast("DummyVecEnv", env_of(model).unwrapped)
        first, second = (cast("OptionsWrapper", env)._random for env in inner.envs)
        assert first.bit_generator.state != second.bit_generator.state
    assert np.array_equal(draws[0], draws[1])


def test_options_that_move_in_by_hand_run() -> None:
    model = expand_action_space(small_model(buffer_size=500, **RANDOM), 2)
    env_of(model).env_method("set_option", 1, steady_option(2, max_duration=3))
    model.learn(60)
    assert N_PRIMITIVE + 1 in model.replay_buffer.actions[:, 0]
