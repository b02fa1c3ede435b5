"""The quick masked distribution is sb3-contrib's, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.distributions import MaskableCategoricalDistribution, make_masked_proba_distribution

from sb3_options import OptionsWrapper
from sb3_options.callbacks import PrimitiveStepsCallback
from sb3_options.learning import families
from sb3_options.learning.masked_distribution import QuickMaskableDistribution, quick
from tests.support.sb3_helpers import Corridor

N = 13


def everything(of: type[MaskableCategoricalDistribution], logits: torch.Tensor, masks: list[Any]) -> list[bytes]:
    """All that a policy asks of a distribution, after each of several masks."""
    given = logits.clone().requires_grad_()
    distribution = of(N).proba_distribution(action_logits=given)
    answers = []
    for seed, mask in enumerate(masks):
        distribution.apply_masking(mask)
        torch.manual_seed(seed)
        actions = distribution.get_actions()
        log_prob, entropy = distribution.log_prob(actions), distribution.entropy()
        (gradient,) = torch.autograd.grad((log_prob + 0.1 * entropy).mean(), given, retain_graph=True)
        inner: Any = distribution.distribution
        drawn = inner.sample(torch.Size([3]))
        answers += [actions, log_prob, entropy, gradient, distribution.mode(), inner.logits, inner.probs, drawn]
        answers += [inner.mode, inner.enumerate_support()]
        assert inner.param_shape == (len(logits), N)
    return [answer.detach().numpy().tobytes() for answer in answers]


@pytest.mark.parametrize("size", [1, 10, 1000])
@pytest.mark.parametrize("batch", [1, 33])
def test_every_answer_is_that_of_sb3_contrib(size: float, batch: int) -> None:
    rng = np.random.default_rng(0)
    logits = size * torch.as_tensor(rng.normal(size=(batch, N)), dtype=torch.float32)
    mask = rng.random((batch, N)) < 0.4
    mask[:, 3] = True
    masks = [None, mask, torch.as_tensor(~mask | mask[:, ::-1].copy()), mask.ravel(), None]
    assert everything(QuickMaskableDistribution, logits, masks) == everything(
        MaskableCategoricalDistribution, logits, masks
    )


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_logits_that_are_no_numbers_are_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="NaN or infinite"):
        QuickMaskableDistribution(2).proba_distribution(torch.tensor([[0.0, wrong]]))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1), (3, 4)])
def test_log_prob_broadcasts(shape: tuple[int, ...]) -> None:
    answers = [
        of(N).proba_distribution(torch.arange(4.0 * N).reshape(4, N)).log_prob(torch.ones(shape))
        for of in (QuickMaskableDistribution, MaskableCategoricalDistribution)
    ]
    assert torch.equal(*answers)


def test_an_answer_without_gradients_does_not_take_them_from_the_next() -> None:
    logits = torch.zeros(2, N, requires_grad=True)
    distribution = QuickMaskableDistribution(N).proba_distribution(logits)
    with torch.no_grad():
        distribution.entropy()
    assert distribution.entropy().requires_grad


def test_a_mask_that_is_used_again_changes_nothing_later() -> None:
    mask = np.array([[True, True, False]])
    distribution = QuickMaskableDistribution(3).proba_distribution(torch.zeros(1, 3))
    distribution.apply_masking(mask)
    mask[:] = True
    assert distribution.distribution.probs.tolist() == [[0.5, 0.5, 0.0]]


def test_other_distributions_stay() -> None:
    several = make_masked_proba_distribution(spaces.MultiDiscrete([2, 3]))
    assert quick(several) is several
    own = QuickMaskableDistribution(2)
    assert quick(own) is own


def test_a_training_learns_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained() -> MaskablePPO:
        env = OptionsWrapper(Corridor(), 2, gamma=0.9)
        model = MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=2, gamma=0.9, seed=0, device="cpu")
        return model.learn(200, callback=PrimitiveStepsCallback())

    ours = trained()
    monkeypatch.setattr(families.Masked, "prepare", lambda self: None)
    stock = trained()
    assert type(ours.policy.action_dist) is QuickMaskableDistribution
    assert type(stock.policy.action_dist) is MaskableCategoricalDistribution
    pairs = zip(ours.policy.parameters(), stock.policy.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
