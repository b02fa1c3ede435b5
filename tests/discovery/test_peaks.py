from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from experiments.common.few_peaks import extent_of
from sb3_options.density.diverse_density import Peak
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods import diverse_density
from sb3_options.discovery.peaks import PeakTracker, TrackedConcept, plateau_centres
from sb3_options.experience.observations import FloatArray
from tests.discovery.lines import peaks_of

A, B = [0.0, 0.0], [5.0, 0.0]
ONES = np.ones(2)


def peaks(*points: Sequence[float]) -> FloatArray:
    return np.array(points, dtype=np.float64).reshape(-1, 2)


@pytest.mark.parametrize(
    ("points", "radius", "centres"),
    [
        ([9, 10, 11], 0.0, [9, 10, 11]),
        ([20, 1, 21, 2, 22, 3], 1.0, [21, 2]),  # in the order of their first peaks
        ([0, 1], 1.0, [0]),  # equally central: the first
        ([1, 0], 1.0, [1]),
    ],
)
def test_plateau_centres(points: list[float], radius: float, centres: list[float]) -> None:
    result = plateau_centres(np.array(points, dtype=np.float64)[:, None], np.ones(1), radius)
    assert result.ravel().tolist() == centres


def test_plateaus_are_made_in_scaled_units() -> None:
    points = peaks([0, 0], [0, 1], [0, 2], [1, 0])
    assert plateau_centres(points, np.array([10.0, 1.0]), 1.0).tolist() == [[0, 1], [1, 0]]
    assert len(plateau_centres(points, np.array([10.0, 10.0]), 1.0)) == 4


@given(
    points=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=1, max_size=30, unique=True),
    radius=st.sampled_from([0.5, 1.0, 1.5, 2.0]),
)
def test_there_is_a_middle_for_each_connected_component(points: list[tuple[int, int]], radius: float) -> None:
    places = np.array(points, dtype=np.float64)
    distances = cdist(places, places)
    _, component = connected_components(distances <= radius, directed=False)
    centres = plateau_centres(places, np.ones(2), radius)
    which = [points.index((int(x), int(y))) for x, y in centres]
    assert list(component[which]) == sorted(set(component))  # one of each, in the order of their first peaks
    farthest = [distances[at, component == component[at]] for at in range(len(places))]
    assert [float(farthest[at].sum()) for at in which] == [
        min(farthest[at].sum() for at in np.flatnonzero(component == label)) for label in sorted(set(component))
    ]
    assert extent_of(places, centres, np.ones(2), radius) == max(farthest[at].max() for at in which)


def test_too_many_peaks_that_tie_have_no_middles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diverse_density, "MOST_TIED", 2)
    method = peaks_of(Discovery(kind="environment"))
    method.filters.scale = ONES
    for n, middles in ((2, 2), (3, 0)):
        method.peaks = [Peak(np.array([10.0 * i, 0.0]), ONES, -1.0, True) for i in range(n)]
        assert method.places().shape == (middles, 2)


def tracked(*searches: list[list[float]], decay: float = 0.5, radius: float = 1.0) -> PeakTracker:
    """After searches that found these peaks each."""
    tracker = PeakTracker(decay=decay, radius=radius)
    for found in searches:
        tracker.update(peaks(*found), ONES)
    return tracker


def points(concepts: Iterable[TrackedConcept]) -> list[list[float]]:
    return [concept.point.tolist() for concept in concepts]


class TestAverages:
    def test_by_hand(self) -> None:
        """λ = 1/2: found, found, missed, found gives 1/2, 3/4, 3/8, 11/16."""
        searches = [[A], [A], [B], [A]]
        averages = [tracked(*searches[:n]).concepts[0].average for n in (1, 2, 3, 4)]
        assert averages == [0.5, 0.75, 0.375, 0.6875]
        # B was found in the third search only: 1/2, then 1/4.
        assert [(c.average, c.found) for c in tracked(*searches).concepts] == [(0.6875, True), (0.25, False)]

    @pytest.mark.parametrize("decay", [0.1, 0.5, 0.75, 0.9])
    def test_rises_to_the_limit(self, decay: float) -> None:
        tracker = PeakTracker(decay=decay)
        assert tracker.limit == pytest.approx(decay / (1 - decay))
        before = 0.0
        for n in range(1, 400):
            tracker.update(peaks(A), ONES)
            average = tracker.concepts[0].average
            # The sum of λ + λ² + … + λⁿ
            assert average == pytest.approx(tracker.limit * (1 - decay**n))
            assert before <= average <= tracker.limit * (1 + 1e-12)
            before = average
        assert average == pytest.approx(tracker.limit)

    @pytest.mark.parametrize(("decay", "threshold", "searches"), [(0.9, 0.6, 9), (0.75, 0.6, 4), (0.5, 0.9, 4)])
    def test_persistent_after_as_many_searches_as_1_minus_decay_to_the_n_exceeds_the_threshold(
        self, decay: float, threshold: float, searches: int
    ) -> None:
        persistent = [tracked(*[[A]] * n, decay=decay).persistent(threshold) for n in range(1, searches + 1)]
        assert persistent[:-1] == [[]] * (searches - 1)
        assert points(persistent[-1]) == [A]

    def test_persistent_are_those_of_the_last_search_largest_first(self) -> None:
        assert points(tracked([B], [A, B]).persistent(0.1)) == [B, A]
        assert points(tracked([B], [A, B], [A]).persistent(0.1)) == [A]
        assert points(tracked([B], [A, B], [A], [A, B]).persistent(0.7)) == [A]

    def test_at_the_threshold_a_peak_does_not_persist_yet(self) -> None:
        assert (tracked([A]).persistent(0.5), points(tracked([A]).persistent(0.499))) == ([], [A])

    def test_leading(self) -> None:
        assert [tracked(*searches).leading_average() for searches in ([], [[A], [B], []])] == [0.0, 0.25]

    def test_forgotten_concepts_are_dropped(self) -> None:
        assert [c.average for c in tracked([A], *[[]] * 8).concepts] == [0.5**9]
        assert tracked([A], *[[]] * 9).concepts == []


class TestAssignment:
    def test_a_peak_belongs_to_the_nearest_concept_within_the_radius(self) -> None:
        tracker = tracked([[0, 0], [3, 0]], [[1.75, 0]], radius=2.0)  # within 2 of both, nearer to the second
        assert [(c.point.tolist(), c.average) for c in tracker.concepts] == [([0, 0], 0.25), ([1.75, 0], 0.75)]

    def test_at_the_radius_and_beyond(self) -> None:
        assert points(tracked([[0, 0]], [[0, 2]], radius=2.0).concepts) == [[0, 2]]
        assert points(tracked([[0, 0]], [[0, 2]], [[0, 4.01]], radius=2.0).concepts) == [[0, 2], [0, 4.01]]

    def test_two_peaks_of_one_concept_count_once_and_the_better_one_places_it(self) -> None:
        tracker = tracked([[0, 0], [1, 0], [0, 0]], radius=2.0)
        assert [(c.point.tolist(), c.average) for c in tracker.concepts] == [([0, 0], 0.5)]

    def test_distances_are_scaled(self) -> None:
        tracker = PeakTracker(decay=0.5, radius=1.0)
        numbers = []
        for place in ([0, 0], [9, 0], [9, 0.2]):
            tracker.update(peaks(place), np.array([0.1, 10.0]))
            numbers.append(len(tracker.concepts))
        assert numbers == [1, 1, 2]

    def test_concepts_do_not_change_with_the_callers_array(self) -> None:
        tracker = PeakTracker()
        found = peaks(A)
        tracker.update(found, ONES)
        found += 7.0
        assert points(tracker.concepts) == [A]
