"""The study of demonstrations."""

import pytest

from experiments.demonstrations.conditions import ARMS, run


@pytest.mark.slow
def test_a_cloned_policy_with_options_succeeds_before_it_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.demonstrations.conditions.TASKS", {"BabyAI-KeyCorridorS3R3-v0": 20_000})
    result = run("BabyAI-KeyCorridorS3R3-v0", ARMS[0], 20, 0)
    assert len(result["options"]) >= 3
    assert result["demonstrations"] > 1000
    assert result["success"] > 0.1
