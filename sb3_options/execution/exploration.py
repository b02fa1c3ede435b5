"""A cap on exploratory option choices.

DQN and QRDQN explore by ``action_space.sample()``, uniformly over all actions. An option lasts many primitive steps.
With as many options as primitives, nearly all exploratory steps would happen inside options.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_options.experience.observations import BoolArray


class CappedActions(spaces.Discrete):
    """Augmented actions whose `sample` draws options up to a given share.

    While uniform choices keep to the share, they are drawn as by ``Discrete``. A primitive, chosen uniformly, replaces
    an empty slot.
    """

    def __init__(self, actions: spaces.Discrete[Any], n_primitive: int, share: float) -> None:
        super().__init__(int(actions.n))
        self._np_random = actions.np_random
        self.n_primitive = n_primitive
        self.share = share
        self.filled: tuple[int, ...] = ()

    def sample(self, mask: Any = None, probability: Any = None) -> Any:
        """Draw an exploratory choice; ``mask`` and ``probability`` as for ``Discrete``."""
        if mask is not None or probability is not None:
            return super().sample(mask, probability)
        if len(self.filled) <= self.share * int(self.n):
            drawn = super().sample()
            if drawn < self.n_primitive or drawn - self.n_primitive in self.filled:
                return drawn
        elif self.np_random.random() < self.share:
            return self.n_primitive + self.np_random.choice(self.filled)
        return self.np_random.integers(self.n_primitive)

    def choose(self, allowed: BoolArray) -> int:
        """Draw an exploratory choice among allowed actions, (n_actions,), uniformly while that keeps to the share."""
        primitive = np.flatnonzero(allowed[: self.n_primitive])
        options = self.n_primitive + np.flatnonzero(allowed[self.n_primitive :])
        total = len(primitive) + len(options)
        if len(primitive) == 0 or len(options) <= self.share * total:
            return int(self.np_random.choice(np.flatnonzero(allowed)))
        return int(self.np_random.choice(options if self.np_random.random() < self.share else primitive))


def cap_option_exploration(model: BaseAlgorithm, n_primitive: int, share: float) -> CappedActions | None:
    """Give a model that explores by ``action_space.sample()`` a `CappedActions`, and return it; None for any other."""
    if not hasattr(model, "exploration_rate") or not isinstance(model.action_space, spaces.Discrete):
        return None
    model.action_space = capped = CappedActions(model.action_space, n_primitive, share)
    return capped
