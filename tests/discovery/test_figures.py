import dataclasses
import functools
import io
from collections.abc import Callable
from typing import Any

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import pytest
import torch
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import discovery_figures, subgoals_figure
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.creation import learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from tests.discovery.lines import peaks_of
from tests.support.helpers import steady_option, trajectory_of
from tests.support.sb3_helpers import n_colours, small_rooms

NAMES = ["diverse_density", "first_visits", "initiation_set", "option_policy"]


def walks(n: int) -> list[Trajectory]:
    """Random walks through the small rooms, as observed."""
    env, rng = small_rooms(observation="xy"), np.random.default_rng(0)
    found = []
    for i in range(n):
        observation, _ = env.reset(seed=i)
        seen, actions, over, success = [observation], [], False, False
        while not over:
            actions.append(int(rng.integers(4)))
            observation, _, terminated, truncated, _ = env.step(actions[-1])
            seen.append(observation)
            over, success = terminated or truncated, terminated
        found.append(trajectory_of(seen, actions, terminated=success, is_success=success))
    return found


@functools.cache
def discovered(
    kind: str | None, features: Callable[[Any], npt.NDArray[np.float64]], n: int = 30
) -> tuple[Discovery, OptionBank]:
    """Discovery over random walks, up to its first option."""
    discovery = Discovery(DiscoverySettings(min_positive=3, start_radius=0.5, goal_radius=1.5, decay=0.5), kind=kind)
    bank = OptionBank(4, 2)
    for trajectory in walks(n):
        discovery.add(trajectory, features(np.asarray(trajectory.states, dtype=np.float64)))
        if bank.filled:
            continue
        subgoal = discovery.search()
        if subgoal is not None:
            option = learn_option(subgoal, discovery.database, 4, OptionLearningSettings(), torch.Generator())
            assert option is not None
            bank.add(option)
    assert len(bank) == 1
    return discovery, bank


def xy(states: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return states


def one_hot(states: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    cells: npt.NDArray[np.float64] = np.eye(45)[(states[:, 0] + 9 * states[:, 1]).astype(int)]
    return cells


def drawn(figure: Figure) -> npt.NDArray[np.uint8]:
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return np.asarray(iio.imread(file.getvalue()))


def colours(figure: Figure) -> int:
    return n_colours(drawn(figure))


def patches(figure: Figure) -> PatchCollection:
    return next(c for c in figure.axes[0].collections if isinstance(c, PatchCollection))


class TestMaps:
    def test_there_are_four(self) -> None:
        figures = discovery_figures(*discovered("environment", xy))
        assert list(figures) == NAMES
        assert all(colours(figure) > 20 for figure in figures.values())

    def test_diverse_density_is_the_engines_in_every_cell_seen(self) -> None:
        discovery, bank = discovered("environment", xy)
        squares = patches(discovery_figures(discovery, bank)["diverse_density"])
        seen = np.unique(np.concatenate([t.features for t in discovery.database]), axis=0)
        completed = peaks_of(discovery).completed
        assert completed is not None
        values = np.asarray(peaks_of(discovery).engine().log_density(seen, completed.bags))
        worst = min(values.max() - 60, np.quantile(values, 0.75))
        np.testing.assert_allclose(squares.get_array(), np.maximum(values, worst))  # type: ignore[arg-type]  # set above
        centres = np.array([path.get_extents().get_points().mean(axis=0) for path in squares.get_paths()])
        np.testing.assert_allclose(centres, seen, atol=1e-9)

    def test_first_visits_count_successful_trajectories(self) -> None:
        discovery, bank = discovered("environment", xy)
        seen = np.unique(np.concatenate([t.features for t in discovery.database]), axis=0)
        expected = [
            sum(t.success and bool((t.features == cell).all(axis=1).any()) for t in discovery.database) for cell in seen
        ]
        counts = patches(discovery_figures(discovery, bank)["first_visits"]).get_array()
        assert np.asarray(counts).tolist() == expected
        assert max(expected) == sum(t.success for t in discovery.database)

    def test_a_star_marks_the_subgoal(self) -> None:
        discovery, bank = discovered("environment", xy)
        for figure in discovery_figures(discovery, bank).values():
            (star,) = [line for line in figure.axes[0].lines if line.get_marker() == "*"]
            assert [np.ravel(c)[0] for c in star.get_data()] == discovery.found[0].subgoal.points[0].tolist()

    def test_start_and_goal_are_marked_and_the_legend_names_the_marks(self) -> None:
        discovery, bank = discovered("environment", xy)
        starts = {tuple(t.features[0]) for t in discovery.database}
        goals = {tuple(t.features[t.trajectory.visits[-1]]) for t in discovery.database if t.success}
        assert len(goals) == 1
        for figure in discovery_figures(discovery, bank).values():
            marked = {line.get_marker(): np.asarray(line.get_xydata()) for line in figure.axes[0].lines}
            assert {line.get_linestyle() for line in figure.axes[0].lines} == {"None"}, "marks are not joined"
            assert {tuple(p) for p in marked["o"]} == starts
            assert {tuple(p) for p in marked["D"]} == goals
            (legend,) = figure.legends
            assert [t.get_text() for t in legend.get_texts()] == ["start", "goal: where a success ended", "subgoal"]

    def test_without_a_leak_a_quarter_of_the_states_is_told_apart(self) -> None:
        discovery, bank = discovered("environment", xy)
        settings = dataclasses.replace(discovery.settings, leak=0.0, scale=4.0, start_radius=0.0, goal_radius=0.0)
        discovery = Discovery(settings, kind="environment")
        for trajectory in walks(30):
            discovery.add(trajectory, xy(np.asarray(trajectory.states, dtype=np.float64)))
        discovery.search()
        seen = np.unique(np.concatenate([t.features for t in discovery.database]), axis=0)
        values = discovery.method.log_density(seen)
        assert values is not None
        assert (values > values.max() - 60).mean() < 0.15  # a fixed scale would show these only
        shown = np.asarray(patches(discovery_figures(discovery, bank)["diverse_density"]).get_array())
        assert (shown > shown.min()).mean() >= 0.2

    def test_arrows_lead_to_the_subgoal(self) -> None:
        discovery, bank = discovered("environment", xy)
        axes = discovery_figures(discovery, bank)["option_policy"].axes[0]
        (arrows,) = [c for c in axes.collections if isinstance(c, Quiver)]
        moves = np.column_stack([arrows.U, arrows.V])
        starts = np.asarray(arrows.get_offsets()) + moves / 2
        cells = np.asarray(bank[0].initiation_set.points)  # type: ignore[union-attr]  # discovered
        assert {tuple(s) for s in starts.round(6)} <= {tuple(c) for c in cells}
        assert len(starts) > 0.7 * len(cells)
        lengths = np.linalg.norm(moves, axis=1)
        np.testing.assert_allclose(lengths[lengths > 0], 0.8, err_msg="however seldom an action succeeds")
        subgoal = discovery.found[0].subgoal.points[0]
        nearer = np.linalg.norm(starts + 0.1 * moves - subgoal, axis=1) < np.linalg.norm(starts - subgoal, axis=1)
        assert nearer.mean() > 0.7

    def test_one_picture_of_all(self) -> None:
        figure = subgoals_figure(*discovered("environment", xy))
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert titles == [
            "log diverse density",
            "successful trajectories that visit",
            "initiation set",
            "option policy: where the greedy action leads",
        ]
        assert colours(figure) > 50


@pytest.mark.parametrize(
    ("kind", "features"),
    [
        ("identity", lambda s: s[:, :1]),
        ("identity", lambda s: np.column_stack([s, s[:, 0] * s[:, 1]])),
        ("given", lambda s: 2.0 * s),
    ],
    ids=["one", "three", "scaled"],
)
def test_spaces_of_other_sizes(kind: str, features: Callable[[Any], npt.NDArray[np.float64]]) -> None:
    discovery, bank = discovered(kind, features)
    figures = discovery_figures(discovery, bank)
    assert list(figures) == NAMES
    assert all(colours(figure) > 20 for figure in figures.values())
    assert colours(subgoals_figure(discovery, bank)) > 50


def test_numbered_states_are_bars() -> None:
    discovery, bank = discovered("categorical", one_hot)
    figures = discovery_figures(discovery, bank)
    assert list(figures) == NAMES[:2]
    for figure in figures.values():
        states = np.asarray(figure.axes[0].lines[0].get_xdata())
        assert len(states) == len(np.unique(states)) > 30
        marked = {line.get_marker(): np.asarray(line.get_xydata()) for line in figure.axes[0].lines}
        assert marked["*"][0, 0] == discovery.found[0].subgoal.points[0].argmax()
        assert marked["*"][0].tolist() in marked["."].tolist()
        assert set(marked) == {".", "o", "D", "*"}
        assert figure.axes[0].get_xlabel() == "number of the state"
        assert figure.axes[0].get_ylabel() in ("nats", "trajectories")


def test_before_any_search_there_is_nothing_to_draw() -> None:
    empty = Discovery()
    assert discovery_figures(empty, OptionBank(4, 2)) == {}
    (text,) = subgoals_figure(empty, OptionBank(4, 2)).axes[0].texts
    assert text.get_text().startswith("No subgoal was discovered: no episode has ended. Train for longer")
    (text,) = subgoals_figure(empty, OptionBank(4, 2), "Discovery was switched off.").axes[0].texts
    assert text.get_text() == "Discovery was switched off."


def test_before_any_option_there_are_two_maps() -> None:
    discovery = Discovery(DiscoverySettings(min_positive=3, goal_radius=1.5, decay=0.9), kind="environment")
    for trajectory in walks(12):
        discovery.add(trajectory, xy(np.asarray(trajectory.states, dtype=np.float64)))
    discovery.search()
    assert list(discovery_figures(discovery, OptionBank(4, 2))) == NAMES[:2]


def test_hand_made_options_are_left_out() -> None:
    discovery, _ = discovered("environment", xy)
    bank = OptionBank(4, 2)
    bank.add(steady_option())
    assert list(discovery_figures(discovery, bank)) == NAMES[:2]


def test_features_that_are_0_and_minus_0_are_one_place() -> None:
    def signed(states: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        signs: npt.NDArray[np.float64] = np.where(np.arange(len(states)) % 2, 0.0, -0.0)[:, None]
        return np.where(states == 0.0, signs, states)

    figures = discovery_figures(*discovered(None, signed))
    assert list(figures) == list(discovery_figures(*discovered(None, xy)))


def test_options_on_groups_of_features_are_left_out() -> None:
    discovery, bank = discovered(None, xy)
    both, group = OptionBank(4, 2), FeatureGroup("column", [1])
    column = Region(np.array([[4.0]]), np.ones(1), 0.5, group=group)
    policy = TabularPolicy(np.array([[4.0]]), np.eye(4)[:1])
    both.add(SubgoalOption(column, column, policy, policy_input="features"))
    assert bank[0] is not None
    both.add(bank[0])
    alone = OptionBank(4, 2)
    alone.add(bank[0], 1)
    for name, figure in discovery_figures(discovery, both).items():
        assert np.array_equal(drawn(figure), drawn(discovery_figures(discovery, alone)[name]))
