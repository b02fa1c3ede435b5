"""Learns an option's policy by experience replay: Q-learning into a table or a network."""

from itertools import pairwise

import numpy as np
import torch

from sb3_options.experience.observations import BoolArray, flatten
from sb3_options.options.policies import NetworkPolicy, TabularPolicy
from sb3_options.options.tasks import Transitions

HIDDEN = 64  # units of each of the network's two hidden layers
BATCH = 128  # transitions per gradient step
LEARNING_RATE = 1e-3  # of Adam
TARGET_SYNC = 100  # gradient steps between two updates of the state values in the targets


def replay_into_table(transitions: Transitions, n_primitive: int, *, gamma: float, sweeps: int) -> TabularPolicy:
    """Run Q-learning by repeated replay of all transitions (Lin 1992), with step size 1/N(s, a).

    Every sweep sets Q(s, a) to the mean of r + γ max_a' Q(s', a') over the transitions of (s, a), without the second
    term where the task ends. This is the fixed point of experience replay. An action that was never tried in a state
    keeps −∞. So does an action that only led to states in which no saved trajectory acted: what follows them is
    unknown. Replay stops when nothing changes, or after ``sweeps``.
    """
    states = flatten(transitions.states)
    n_states = len(states)
    known = _known(transitions, n_states)
    began, led = transitions.began[known], transitions.led[known]
    rewards, goes_on = transitions.rewards[known], ~transitions.ends[known]
    pair = began * n_primitive + transitions.actions[known]
    count = np.bincount(pair, minlength=n_states * n_primitive)
    tried = count > 0
    acted_in: BoolArray = np.any(tried.reshape(n_states, n_primitive), axis=1)
    values = np.where(tried, 0.0, -np.inf)
    for _ in range(sweeps):
        best = np.where(acted_in, values.reshape(n_states, n_primitive).max(axis=1), 0.0)
        target = rewards + gamma * goes_on * best[led]
        updated = values.copy()
        updated[tried] = np.bincount(pair, weights=target, minlength=len(count))[tried] / count[tried]
        if np.array_equal(updated, values):
            break
        values = updated
    return TabularPolicy(states[acted_in], values.reshape(n_states, n_primitive)[acted_in])


def _known(transitions: Transitions, n_states: int) -> BoolArray:
    """Return which steps end the task or lead to a state where such steps begin, shape (n,)."""
    known = np.ones(len(transitions.began), dtype=bool)
    while True:
        acted_in = np.zeros(n_states, dtype=bool)
        acted_in[transitions.began[known]] = True
        still = known & (transitions.ends | acted_in[transitions.led])
        if still.sum() == known.sum():
            return known
        known = still


def replay_into_network(
    transitions: Transitions, n_primitive: int, *, gamma: float, updates: int, generator: torch.Generator
) -> NetworkPolicy:
    """Run Q-learning by replay (Lin 1992) into a network with two hidden layers and a target network.

    The generator draws the first weights and the batches of the ``updates`` gradient steps.
    """
    states = flatten(transitions.states)
    mean, std = states.mean(axis=0), states.std(axis=0)
    std = np.where(std > 1e-8, std, 1.0)
    inputs = torch.as_tensor((states - mean) / std, dtype=torch.float32)
    began, led = torch.as_tensor(transitions.began), torch.as_tensor(transitions.led)
    actions = torch.as_tensor(transitions.actions, dtype=torch.int64)[:, None]
    rewards = torch.as_tensor(transitions.rewards, dtype=torch.float32)
    goes_on = torch.as_tensor(~transitions.ends, dtype=torch.float32)

    sizes = [inputs.shape[1], HIDDEN, HIDDEN, n_primitive]
    online = torch.nn.Sequential()
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        # Default initialisation would draw from torch's global generator, which the agent's own training uses.
        layer = torch.nn.utils.skip_init(torch.nn.Linear, n_in, n_out)  # type: ignore[no-untyped-call]  # unannotated
        torch.nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        torch.nn.init.zeros_(layer.bias)
        online.append(layer)
        if i < len(sizes) - 2:
            online.append(torch.nn.ReLU())
    optimizer = torch.optim.Adam(online.parameters(), lr=LEARNING_RATE)
    state_value = torch.zeros(len(inputs))
    for update in range(updates):
        if update > 0 and update % TARGET_SYNC == 0:
            with torch.no_grad():
                state_value = online(inputs).max(dim=1).values
        batch = torch.randint(len(began), (BATCH,), generator=generator)
        target = rewards[batch] + gamma * goes_on[batch] * state_value[led[batch]]
        predicted = online(inputs[began[batch]]).gather(1, actions[batch])[:, 0]
        loss = torch.nn.functional.smooth_l1_loss(predicted, target)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        optimizer.step()
    layers = [layer for layer in online if isinstance(layer, torch.nn.Linear)]
    weights = [layer.weight.detach().numpy().T.astype(np.float64) for layer in layers]
    biases = [layer.bias.detach().numpy().astype(np.float64) for layer in layers]
    return NetworkPolicy(mean, std, weights, biases)
