"""NovelD and E3B against what their papers' equations give."""

from typing import Any

import numpy as np
import torch

from sb3_options.experience.observations import flatten
from sb3_options.learning.episodic_novelty import ALPHA, RIDGE, EllipticalBonus, NovelD
from sb3_options.learning.novelty import Steps, as_array
from tests.learning.test_novelty import still

PLACES = np.eye(6)


def walk(places: list[int], env: int = 0, *, begins: bool = True) -> Steps:
    """Primitive steps from place to place, by the action that is the number of the place arrived in."""
    n = len(places) - 1
    before, after = PLACES[places[:-1]], PLACES[places[1:]]
    return Steps(before, np.array(places[1:]), after, np.full(n, env), np.arange(n) < begins)


def joined(*parts: Steps) -> Steps:
    return Steps(*map(np.concatenate, zip(*parts, strict=True)))


class TestNovelD:
    def test_only_first_visits_of_an_episode_count(self) -> None:
        bonuses = NovelD(6, 0).bonuses(walk([0, 1, 2, 1, 0, 3]))
        assert (bonuses[[0, 1, 4]] > 0).all()
        assert (bonuses[[2, 3]] == 0).all()

    def test_each_environment_has_its_own_episode(self) -> None:
        noveld = NovelD(6, 0)
        assert (noveld.bonuses(joined(walk([0, 1, 2]), walk([2, 1, 0], env=1))) > 0).all()
        later = joined(walk([2, 0, 1], begins=False), walk([0, 1, 2], env=1, begins=False))
        assert not noveld.bonuses(later).any()

    def test_an_episode_forgets_the_one_before(self) -> None:
        noveld = NovelD(6, 0)
        for _ in range(3):
            assert noveld.bonuses(walk([0, 1, 2])).any()
        assert not noveld.bonuses(walk([2, 1, 2, 0], begins=False)).any()

    def test_bonus_is_the_gain_of_novelty(self) -> None:
        noveld = still(NovelD(6, 0))
        bonuses = noveld.bonuses(walk([0, 1, 2, 3]))
        novelty = np.sqrt(as_array(noveld.errors(noveld.normalized(PLACES[:4]))))
        np.testing.assert_allclose(bonuses, np.maximum(novelty[1:] - ALPHA * novelty[:-1], 0.0), rtol=1e-5)

    def test_rounding_errors_make_no_first_visit(self) -> None:
        noveld = NovelD(6, 0)
        there = walk([0, 1, 2])
        noveld.bonuses(there)
        back = walk([2, 1, 0], begins=False)
        assert not noveld.bonuses(back._replace(after=flatten(back.after) - 1e-7)).any()


class TestE3B:
    def test_bonus_is_that_of_the_inverse_of_the_matrix(self) -> None:
        e3b = still(EllipticalBonus(6, 6))
        matrices: dict[int, Any] = {}
        for env, places, begins in (
            (0, [0, 1, 2, 1], True),
            (1, [3, 3, 4], True),
            (0, [1, 5], False),
            (0, [2, 2], True),
        ):
            bonuses = e3b.bonuses(walk(places, env, begins=begins))
            first, *features = self.features(e3b, places)
            if begins:
                matrices[env] = RIDGE * np.eye(64) + np.outer(first, first)
            for bonus, feature in zip(bonuses, features, strict=True):
                np.testing.assert_allclose(bonus, feature @ np.linalg.solve(matrices[env], feature), rtol=1e-6)
                matrices[env] += np.outer(feature, feature)

    @staticmethod
    def features(e3b: EllipticalBonus, places: list[int]) -> Any:
        with torch.no_grad():
            return e3b.encoder(e3b.normalized(PLACES[places])).double().numpy()

    def test_the_encoder_learns_to_tell_actions(self) -> None:
        e3b, random = EllipticalBonus(6, 6), np.random.default_rng(0)
        e3b.bonuses(walk(random.integers(6, size=65).tolist()))
        first = e3b.records()["loss"]
        for _ in range(100):
            e3b.bonuses(walk(random.integers(6, size=65).tolist()))
        assert e3b.records()["loss"] < 0.2 * first
