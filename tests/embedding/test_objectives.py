"""The objective, in numbers that can be worked out by hand, and pairs and encoders."""

import numpy as np
import pytest
import torch

from sb3_options.embedding.encoders import Encoder, ObservationForm, as_tensor, form_of_array
from sb3_options.embedding.learned_map import LearnedMap
from sb3_options.embedding.learner import SOFT, contrastive_loss, energies
from sb3_options.embedding.pairs import Replay
from tests.embedding.truth import path_through
from tests.support.helpers import equal

TABLE = ObservationForm("table", (6,))

DRAWS = torch.Generator().manual_seed(0)


class TestTemporalDistance:
    def test_energy_is_potential_minus_distance(self) -> None:
        x, y = torch.tensor([[0.0, 0.0, 9.0], [3.0, 0.0, 9.0]]), torch.tensor([[3.0, 4.0, 0.5], [0.0, 0.0, -1.0]])
        expected = torch.tensor([[0.5 - 5.0, -1.0], [0.5 - 4.0, -1.0 - 3.0]])
        torch.testing.assert_close(energies(x, y), expected, atol=SOFT**0.5, rtol=0.0)

    def test_the_loss_is_that_of_finding_one_by_the_other(self) -> None:
        x, y = torch.tensor([[0.0, 0.0], [4.0, 0.0]]), torch.tensor([[0.0, 1.0], [4.0, 0.0]])
        logits = energies(x, y)
        rows, columns = torch.log_softmax(logits, dim=1), torch.log_softmax(logits, dim=0)
        expected = -0.5 * (rows.diagonal().mean() + columns.diagonal().mean())
        torch.testing.assert_close(contrastive_loss(x, y), expected)

    def test_equal_observations_have_a_slope(self) -> None:
        x = torch.zeros(2, 3, requires_grad=True)
        contrastive_loss(x, x).backward()  # type: ignore[no-untyped-call]  # torch ships no annotation for it
        assert x.grad is not None
        assert bool(torch.isfinite(x.grad).all())


class TestReplay:
    def test_distinct_observations_and_steps_that_move(self) -> None:
        replay = Replay([path_through([4, 4, 5]), path_through([5, 2])], TABLE, DRAWS)
        assert replay.observations.tolist() == [4, 5, 2]
        assert [replay.observations[rows].tolist() for rows in replay.steps()] == [[4, 5], [5, 2]]

    def test_pairs_lie_ahead_in_one_trajectory_geometrically(self) -> None:
        replay = Replay([path_through([0, 1, 2, 3]), path_through([4, 5])], TABLE, DRAWS)
        began, led = (rows.numpy() for rows in replay.sample(20_000, 2.0, torch.Generator().manual_seed(0)))
        counts = np.zeros((6, 6))
        np.add.at(counts, (began, led), 1)
        # Each of the four that something follows begins equally often; γ = 1/2.
        expected = np.zeros((6, 6))
        expected[0, 1:4] = np.array([4, 2, 1]) / 7
        expected[1, 2:4] = np.array([2, 1]) / 3
        expected[2, 3] = expected[4, 5] = 1.0
        np.testing.assert_allclose(counts / 5_000, expected, atol=0.03)

    def test_seldom_places_begin_as_often_as_others(self) -> None:
        replay = Replay([path_through([0, 1, 0, 1, 0, 1, 0, 1, 2, 3])], TABLE, DRAWS)
        began, _ = replay.sample(3_000, 5.0, torch.Generator().manual_seed(0))
        np.testing.assert_allclose(np.bincount(began.numpy()) / 3_000, [1 / 3, 1 / 3, 1 / 3], atol=0.04)

    @pytest.mark.parametrize(("n_held", "expected"), [(0.5, 1), (1, 1), (2.5, 2), (3, 3)])
    def test_some_are_drawn_of_more_than_it_holds(
        self, n_held: float, expected: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        walks = [path_through([2 * i, 2 * i + 1]) for i in range(3)]
        monkeypatch.setattr("sb3_options.embedding.pairs.MOST_BYTES", n_held * walks[0].n_bytes)
        drawn = [Replay(walks, TABLE, DRAWS).observations.tolist() for _ in range(40)]
        assert all(len(each) == 2 * expected and each == sorted(each) for each in drawn)
        assert {place for each in drawn for place in each} == {*range(6)}


class TestEncoder:
    @pytest.mark.parametrize(
        ("shape", "dtype", "kind", "expected"),
        [
            ((40, 84, 3), np.uint8, "image", (3, 40, 84)),
            ((4, 84, 84), np.uint8, "image", (4, 84, 84)),
            ((20, 20, 3), np.uint8, "vector", (1200,)),
            ((40, 84, 3), np.float32, "vector", (10080,)),
            ((7,), np.float64, "vector", (7,)),
        ],
    )
    def test_forms(self, shape: tuple[int, ...], dtype: type, kind: str, expected: tuple[int, ...]) -> None:
        form = form_of_array(shape, np.dtype(dtype))
        assert (form.kind, form.shape) == (kind, expected)

    def test_every_pixel_counts(self) -> None:
        """A layer without padding overlooked the last row of cells of two rooms."""
        form = form_of_array((40, 84, 3), np.dtype(np.uint8))
        encoder = Encoder(form, 3)
        images = torch.rand(1, *form.shape, requires_grad=True)
        encoder(images).sum().backward()
        assert images.grad is not None
        assert bool((images.grad.abs().sum(dim=1) > 0).all())

    def test_channels_come_first(self) -> None:
        image = np.arange(40 * 50 * 3).astype(np.uint8).reshape(1, 40, 50, 3)
        made = as_tensor(image, form_of_array(image.shape[1:], image.dtype))
        np.testing.assert_array_equal(made, image.transpose(0, 3, 1, 2))

    def test_what_never_moves_is_nothing(self) -> None:
        encoder = Encoder(ObservationForm("vector", (2,)), 3)
        encoder.standardise_by(torch.tensor([[7.0, 0.0], [7.0, 1.0]]))
        one, other = encoder(torch.tensor([[7.0, 1.0]])), encoder(torch.tensor([[7.0, 0.0]]))
        assert (one - other).abs().max() > 1e-3
        np.testing.assert_allclose(encoder.factor.tolist()[1], 2.0)

    def test_numbers_count_from_the_first_and_a_dictionary_is_laid_flat(self) -> None:
        assert as_tensor(np.array([5, 7]), ObservationForm("table", (3,), 5)).tolist() == [0, 2]
        made = as_tensor({"b": np.array([[2, 3]]), "a": np.array([[1]])}, ObservationForm("vector", (3,)))
        assert made.tolist() == [[1.0, 2.0, 3.0]]


class TestLearnedMap:
    FORM = ObservationForm("vector", (2,))

    def test_an_observation_has_the_same_features_in_every_batch(self) -> None:
        phi = LearnedMap(self.FORM)
        batch = np.random.default_rng(0).normal(size=(700, 2))
        together = phi(batch)
        assert together.shape == (700, phi.size)
        np.testing.assert_array_equal(together, np.concatenate([phi(batch[i : i + 1]) for i in range(700)]))
        assert phi(batch[:0]).shape == (0, phi.size)

    def test_arrays_and_back(self) -> None:
        one, other = LearnedMap(self.FORM, seed=0), LearnedMap(self.FORM, seed=1)
        one.scale, one.learned = one.scale * 3.0, 4
        other.load(one.arrays())
        assert equal(one.arrays(), other.arrays())
        assert other.learned == 4
        np.testing.assert_array_equal(one(np.ones((1, 2))), other(np.ones((1, 2))))

    @pytest.mark.parametrize(
        ("made", "message"),
        [
            (LearnedMap(ObservationForm("vector", (3,))), r"expected \(2,\)\. Observations must be those"),
            (LearnedMap(ObservationForm("table", (2,))), r"^the learned feature map does not fit: "),
        ],
    )
    def test_arrays_of_another(self, made: LearnedMap, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            LearnedMap(self.FORM).load(made.arrays())

    def test_arrays_that_are_not_finite(self) -> None:
        phi = LearnedMap(self.FORM)
        with pytest.raises(ValueError, match=r"^the learned feature map holds numbers that are not finite$"):
            phi.load(phi.arrays() | {"scale": np.full(phi.size, np.nan)})
