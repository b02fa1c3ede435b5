"""A model that was trained without options, and what of it is still the same once it has slots."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_options import OptionReplayBuffer, expand_action_space
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.learning import heads
from tests.learning import expanded
from tests.support.sb3_helpers import Corridor, env_of, places, small_rooms


def old_rows(rows: torch.Tensor, outputs_per_action: int) -> torch.Tensor:
    by_action = rows.reshape(outputs_per_action, -1, *rows.shape[1:])
    return by_action[:, : -expanded.MAX_OPTIONS].flatten(0, 1)


def weights_of_old(model: Any, stock: Any) -> list[tuple[str, torch.Tensor, torch.Tensor]]:
    """Every parameter of both, without the rows of slots."""
    per_action = expanded.N_QUANTILES if isinstance(model, QRDQN) else 1
    before, after = stock.policy.state_dict(), model.policy.state_dict()
    assert list(before) == list(after)
    return [
        (key, old, new if new.shape == old.shape else old_rows(new, per_action))
        for (key, old), new in zip(before.items(), after.values(), strict=True)
    ]


@expanded.every_and_a_size_that_matters
def test_outputs_for_old_actions_are_the_same(name: str, max_options: int) -> None:
    model = expanded.trained(name)
    batches = [expanded.random_observations(model, n) for n in (1, 3, 64)]
    before = [expanded.outputs(model, batch) for batch in batches]
    chosen = [model.predict(batch, deterministic=True)[0] for batch in batches]
    assert expand_action_space(model, max_options) is model
    for opened in (None, *range(max_options)):
        if opened is not None:
            heads.open_head(model.policy, expanded.N_PRIMITIVE + opened, expanded.N_PRIMITIVE)
        for batch, old in zip(batches, before, strict=True):
            new = expanded.outputs(model, batch)
            assert len(old) == len(new) == (2 if name in ("dqn", "qrdqn") else 1)
            for a, b in zip(old, new, strict=True):
                assert b.shape[-1] == expanded.N_PRIMITIVE + max_options
                torch.testing.assert_close(a, b[..., : expanded.N_PRIMITIVE])
        if opened is None:
            assert all(heads.is_closed(model.policy, expanded.N_PRIMITIVE + i) for i in range(max_options))
            for batch, actions in zip(batches, chosen, strict=True):
                assert np.array_equal(actions, model.predict(batch, deterministic=True)[0])


@pytest.mark.parametrize(
    ("name", "kind"),
    [("ppo", "box"), ("dqn", "discrete"), ("dqn", "dict"), ("ppo", "dict_discrete"), ("dqn", "image")],
)
def test_every_kind_of_observation(name: str, kind: str) -> None:
    algorithm = expanded.KINDS[name].algorithm
    policy = {"image": "CnnPolicy", "dict": "MultiInputPolicy", "dict_discrete": "MultiInputPolicy"}
    own = {"n_epochs": 1} if name == "ppo" else {"buffer_size": 100}
    kwargs = expanded.KINDS[name].kwargs | {"batch_size": 16} | own
    model = algorithm(policy.get(kind, "MlpPolicy"), Corridor(kind), gamma=expanded.GAMMA, seed=0, **kwargs).learn(64)
    seen = env_of(model).reset()
    before = expanded.outputs(model, seen)
    expand_action_space(model, 2, feature_map=places)
    after = expanded.outputs(model, seen)
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(old, new[..., :2])
    assert isinstance(env_of(model), VecTransposeImage) == (kind in ("image", "dict"))
    callback = SubgoalDiscoveryCallback()
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == 128
    assert callback.episodes > 0
    if name == "dqn":
        assert model.replay_buffer.size() == 64
        assert (model.replay_buffer.sample(16).discounts == expanded.GAMMA).all()


@expanded.every
def test_training_goes_on_as_it_would_have(name: str) -> None:
    """The same batches, without options: old weights are learned as before, but for rounding."""
    # A norm over more numbers rounds otherwise.
    unclipped: dict[str, Any] = {} if name == "trpo" else {"max_grad_norm": 1e9}
    stock, model = (expanded.trained(name, **unclipped) for _ in range(2))
    rollout = dict(vars(stock.rollout_buffer)) if hasattr(stock, "rollout_buffer") else {}
    expand_action_space(model, expanded.MAX_OPTIONS)
    if name in ("dqn", "qrdqn"):
        model.replay_buffer = stock.replay_buffer
    if name == "maskableppo":  # its masks are wider now; what else was collected goes in again
        narrow = rollout["action_masks"]
        masks = np.pad(narrow, [(0, 0)] * (narrow.ndim - 1) + [(0, expanded.MAX_OPTIONS)])
        kept = {k: v for k, v in rollout.items() if k not in ("action_space", "mask_dims")}
        vars(model.rollout_buffer).update({**kept, "action_masks": masks})
    learned = [old.clone() for _, old, _ in weights_of_old(model, stock)]
    for each in (stock, model):
        set_random_seed(3)
        each.train(*((100, 32) if name in ("dqn", "qrdqn") else ()))
    for key, old, new in weights_of_old(model, stock):
        torch.testing.assert_close(old, new, rtol=0, atol=2e-5, msg=key)
    assert any(not torch.equal(a, old) for a, (_, old, _) in zip(learned, weights_of_old(model, stock), strict=True))
    assert all(heads.is_closed(model.policy, expanded.N_PRIMITIVE + i) for i in range(expanded.MAX_OPTIONS))
    assert stock._n_updates == model._n_updates


@expanded.every
def test_everything_knows_the_new_actions(name: str) -> None:
    model = expanded.trained(name, steps=128)
    random = model.action_space.np_random
    expand_action_space(model, expanded.MAX_OPTIONS)
    expected = spaces.Discrete(expanded.N_ACTIONS)
    assert model.action_space == model.policy.action_space == env_of(model).action_space == expected
    assert model.action_space.np_random is random
    for network in ("q_net", "q_net_target", "quantile_net", "quantile_net_target"):
        if hasattr(model, network):
            assert getattr(model, network) is getattr(model.policy, network)
            assert getattr(model, network).action_space == expected
    buffer = model.replay_buffer if name in ("dqn", "qrdqn") else model.rollout_buffer
    assert buffer.action_space == expected


@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")  # SB3 says so of its own buffer
def test_n_step_returns_of_a_model_that_was_loaded(tmp_path: Path) -> None:
    """SB3 saves no replay buffer."""
    expanded.trained("dqn", steps=128, n_steps=3).save(tmp_path / "model.zip")
    model = expand_action_space(DQN.load(tmp_path / "model.zip", env=small_rooms()), expanded.MAX_OPTIONS)
    model.learn(60, reset_num_timesteps=False, callback=PrimitiveStepsCallback())
    assert cast("Any", model.replay_buffer).n_steps == 3


def test_a_stock_replay_buffer_gives_way_to_an_empty_one() -> None:
    model = expand_action_space(expanded.trained("dqn", steps=64), expanded.MAX_OPTIONS)
    assert isinstance(model.replay_buffer, OptionReplayBuffer)
    assert model.replay_buffer.size() == 0
    assert model.replay_buffer.buffer_size == 1000
    other = expanded.small_model(replay_buffer_class=OptionReplayBuffer, buffer_size=50)
    mine = other.replay_buffer
    expand_action_space(other, expanded.MAX_OPTIONS)
    assert other.replay_buffer is mine
    other.learn(10)
