from typing import Any, cast

import numpy as np
import pytest
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

from sb3_options import OptionDQN, OptionReplayBuffer
from sb3_options.callbacks import PrimitiveStepsCallback, SubgoalDiscoveryCallback
from sb3_options.learning import heads
from sb3_options.learning.families import family_of, forget_slot
from tests.support.sb3_helpers import optioned_rooms

N_PRIMITIVE, MAX_OPTIONS = 4, 3
N_ACTIONS = N_PRIMITIVE + MAX_OPTIONS

algorithms = pytest.mark.parametrize("algorithm", [DQN, OptionDQN, QRDQN])


def model_of(algorithm: Any, **kwargs: Any) -> Any:
    quantiles = {"n_quantiles": 7} if algorithm is QRDQN else {}
    return algorithm(
        "MlpPolicy", optioned_rooms(MAX_OPTIONS), gamma=0.9, seed=1, learning_starts=50, train_freq=4, batch_size=16,
        buffer_size=2000, target_update_interval=40, replay_buffer_class=OptionReplayBuffer,
        policy_kwargs={"net_arch": [32], **quantiles}, **kwargs,
    )  # fmt: skip


def observations(n: int = 1000) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=(n, 45))).float()


@torch.no_grad()
def outputs(model: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the online and the target network, (batch, outputs an action, actions)."""
    seen, name = observations().to(model.device), "quantile_net" if isinstance(model, QRDQN) else "q_net"
    networks = getattr(model.policy, name), getattr(model.policy, f"{name}_target")
    both = [network(seen).reshape(len(seen), -1, N_ACTIONS) for network in networks]
    return both[0], both[1]


def close_all(model: Any) -> None:
    for slot in range(MAX_OPTIONS):
        heads.close_head(model.policy, N_PRIMITIVE + slot)


@algorithms
def test_a_closed_head_never_wins(algorithm: type[OffPolicyAlgorithm]) -> None:
    model = model_of(algorithm)
    with torch.no_grad():
        for layer, _ in heads.option_outputs(model.policy):
            layer.weight *= 100  # values far below and above 0
            layer.bias.sub_(500)
    close_all(model)
    for values in outputs(model):
        assert (values.mean(dim=1).argmax(dim=1) < N_PRIMITIVE).all()
        assert (values[:, :, N_PRIMITIVE:] == heads.CLOSED_VALUE).all()
    assert (model.predict(observations().numpy(), deterministic=True)[0] < N_PRIMITIVE).all()
    with torch.no_grad():
        for layer, _ in heads.option_outputs(model.policy):
            layer.bias.mul_(0.01)  # as weight decay does in time
    assert [heads.is_closed(model.policy, action) for action in (0, N_PRIMITIVE)] == [False, True]


@algorithms
def test_closing_and_opening_leave_all_other_actions_bit_identical(algorithm: type[OffPolicyAlgorithm]) -> None:
    model = model_of(algorithm)
    others = [a for a in range(N_ACTIONS) if a != N_PRIMITIVE + 1]
    before = outputs(model)
    heads.close_head(model.policy, N_PRIMITIVE + 1)
    closed = outputs(model)
    heads.open_head(model.policy, N_PRIMITIVE + 1, N_PRIMITIVE)
    for a, b, c in zip(before, closed, outputs(model), strict=True):
        assert torch.equal(a[:, :, others], b[:, :, others])
        assert torch.equal(a[:, :, others], c[:, :, others])
        assert not torch.equal(b, c)


@algorithms
def test_an_opened_head_is_the_mean_of_the_primitives(algorithm: type[OffPolicyAlgorithm]) -> None:
    model = model_of(algorithm)
    close_all(model)
    heads.open_head(model.policy, N_PRIMITIVE + 2, N_PRIMITIVE)
    for values in outputs(model):
        mean = values[:, :, :N_PRIMITIVE].mean(dim=2)
        torch.testing.assert_close(values[:, :, N_PRIMITIVE + 2], mean, rtol=0, atol=1e-6)
    assert [heads.is_closed(model.policy, N_PRIMITIVE + i) for i in range(3)] == [True, True, False]
    assert not any(heads.is_closed(model.policy, a) for a in range(N_PRIMITIVE))


class Dueling(QNetwork):
    """Of a user's own: the value of a state, and advantages less their mean (Wang et al. 2016)."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.value = torch.nn.Linear(self.features_dim, 1)

    def forward(self, obs: Any) -> torch.Tensor:
        features = self.extract_features(obs, self.features_extractor)
        advantages = self.q_net(features)
        return self.value(features) + advantages - advantages.mean(dim=1, keepdim=True)  # type: ignore[no-any-return]


class Trunk(QNetwork):
    """Of a user's own, whose last layer has another name, and whose outputs are random while it trains."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.q_net = torch.nn.Sequential(torch.nn.Linear(self.features_dim, 16), torch.nn.Dropout())
        self.last = torch.nn.Linear(16, N_ACTIONS)

    def forward(self, obs: Any) -> torch.Tensor:
        return self.last(self.q_net(self.extract_features(obs, self.features_extractor)))  # type: ignore[no-any-return]


class Narrow(Trunk):
    """Of a user's own, without a layer that has an output for each action."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.last = torch.nn.Linear(16, 1)


class Layers(ActorCriticPolicy):
    """Of a user's own: logits from several layers."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = torch.nn.Sequential(torch.nn.Linear(64, 16), torch.nn.Tanh(), torch.nn.Linear(16, N_ACTIONS))
        self.optimizer = torch.optim.Adam(self.parameters(), lr=1e-3)


class Elsewhere(Layers):
    """Of a user's own: the logits come from a layer of another name."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.own_net = torch.nn.Linear(64, N_ACTIONS)

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return self.action_dist.proba_distribution(action_logits=self.own_net(latent_pi))


def own_model(network: type[Any]) -> Any:
    """DQN or PPO with a network of a user's own."""
    env = optioned_rooms(MAX_OPTIONS)
    if issubclass(network, ActorCriticPolicy):
        return PPO(network, env, gamma=0.9, n_steps=64, batch_size=32, n_epochs=1, device="cpu")

    class Policy(DQNPolicy):
        def make_q_net(self) -> QNetwork:
            kwargs = self._update_features_extractor(self.net_args, features_extractor=None)
            return network(**kwargs).to(self.device)  # type: ignore[no-any-return]

    return DQN(Policy, env, gamma=0.9, replay_buffer_class=OptionReplayBuffer, buffer_size=99, learning_starts=20)


@pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback])
@pytest.mark.parametrize("network", [Trunk, Layers])
def test_heads_of_a_users_own_network_are_found_by_their_shape(network: type[Any], callback: Any) -> None:
    model = own_model(network)
    model.learn(128, callback=callback())
    assert [heads.is_closed(model.policy, action) for action in range(N_ACTIONS)] == [False] * 4 + [True] * 3
    seen = observations(64).numpy()
    assert all(model.predict(seen)[0] < N_PRIMITIVE)


@pytest.mark.parametrize("callback", [SubgoalDiscoveryCallback, PrimitiveStepsCallback])
@pytest.mark.parametrize(
    ("network", "message"),
    [
        (Dueling, "Policy changes the outputs of the last torch.nn.Linear of its q_net"),
        (Narrow, r"q_net or quantile_net of Policy must end in torch.nn.Linear\(n, 7\) with a bias"),
        (Elsewhere, "Elsewhere changes the outputs of the last torch.nn.Linear of its action_net"),
    ],
)
def test_networks_of_a_users_own_that_cannot_be_closed_are_refused(
    network: type[Any], message: str, callback: Any
) -> None:
    with pytest.raises(TypeError, match=f"^{message}"):
        own_model(network).learn(10, callback=callback())


@algorithms
@pytest.mark.parametrize(("scale", "training"), [(0.0, True), (1e5, False), (-1e8, True)])
def test_asking_a_network_leaves_it_as_it_is(algorithm: type[OffPolicyAlgorithm], scale: float, training: bool) -> None:
    """Of small values and of large ones, in which an addition of 1 is rounding."""
    model = model_of(algorithm)
    for layer, _ in heads.option_outputs(model.policy):
        layer.bias.data += scale
    heads.close_head(model.policy, N_PRIMITIVE)  # the last slot is open
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model._last_obs = observations(1).numpy()
    model.policy.set_training_mode(training)
    family_of(model).check(model.get_env())
    assert model.policy.training == training
    assert all(torch.equal(before[name], value) for name, value in model.policy.state_dict().items())


def test_a_slot_that_is_forgotten_may_start_nowhere_and_the_others_where_they_may() -> None:
    model = OptionDQN("MlpPolicy", optioned_rooms(2), gamma=0.9, buffer_size=50, learning_starts=1_000)
    model.learn(20, callback=PrimitiveStepsCallback())
    buffer = cast("OptionReplayBuffer", model.replay_buffer)
    buffer.next_available[:] = True
    forget_slot(model, 0, 4)
    assert not buffer.next_available[: buffer.size(), 0].any()
    assert buffer.next_available[:, 1].all()
