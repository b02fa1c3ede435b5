import dataclasses
import functools
import io
from collections.abc import Callable
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.quiver import Quiver

from sb3_options.density.groups import FeatureGroup
from sb3_options.density.regions import Region
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.figures import map_figure, subgoals_figure
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.experience.observations import FloatArray
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.bank import OptionBank
from sb3_options.options.creation import learn_option
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.options.settings import OptionLearningSettings
from tests.discovery.lines import peaks_of, said
from tests.support.helpers import steady_option
from tests.support.sb3_helpers import n_colours, optioned_rooms

DENSITY, VISITS = "log diverse density", "successful trajectories that visit"
POLICY = "option policy: where the greedy action leads"


def walks() -> list[Trajectory]:
    """Random walks through the small rooms, as observed."""
    return optioned_rooms(observation="xy").random_trajectories(30, 150, 0)


@functools.cache
def discovered(kind: str | None, features: Callable[[Any], FloatArray]) -> tuple[Discovery, OptionBank]:
    """Discovery over random walks, up to its first option."""
    discovery = Discovery(DiscoverySettings(min_positive=3, start_radius=0.5, goal_radius=1.5, decay=0.5), kind=kind)
    bank = OptionBank(4, 2)
    for trajectory in walks():
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


def xy(states: FloatArray) -> FloatArray:
    return states


def one_hot(states: FloatArray) -> FloatArray:
    return np.asarray(np.eye(45)[(states[:, 0] + 9 * states[:, 1]).astype(int)])


def maps(discovery: Discovery, bank: OptionBank) -> dict[str, Axes]:
    """The panels by their titles."""
    figure = map_figure(discovery, bank)
    assert figure is not None
    return {axes.get_title(): axes for axes in figure.axes if axes.get_title()}


def patches(axes: Axes) -> PatchCollection:
    return next(c for c in axes.collections if isinstance(c, PatchCollection))


def test_starts_goals_and_the_subgoal_are_marked_beneath_a_text() -> None:
    discovery, bank = discovered("environment", xy)
    figure = subgoals_figure(discovery, bank, "What happened.")
    assert figure.get_suptitle() == "What happened."
    marked = {str(line.get_label()): np.asarray(line.get_xydata()) for line in figure.axes[0].lines}
    assert list(marked) == [text.get_text() for text in figure.legends[0].get_texts()]
    starts, goals, subgoals = marked.values()
    np.testing.assert_array_equal(
        starts, np.unique([t.features[t.trajectory.visits[0]] for t in discovery.database], axis=0)
    )
    assert goals.tolist() == [[8.0, 4.0]]
    assert subgoals.tolist() == [found.centre.tolist() for found in discovery.found]


def test_diverse_density_is_the_engines_in_every_cell_seen() -> None:
    discovery, bank = discovered("environment", xy)
    squares = patches(maps(discovery, bank)[DENSITY])
    seen = np.unique(np.concatenate([t.features for t in discovery.database]), axis=0)
    completed = peaks_of(discovery).completed
    assert completed is not None
    values = np.asarray(peaks_of(discovery).engine().log_density(seen, completed.bags))
    worst = min(values.max() - 60, np.quantile(values, 0.75))
    np.testing.assert_allclose(squares.get_array(), np.maximum(values, worst))  # type: ignore[arg-type]  # set above
    centres = np.array([path.get_extents().get_points().mean(axis=0) for path in squares.get_paths()])
    np.testing.assert_allclose(centres, seen, atol=1e-9)


def test_without_a_leak_a_quarter_of_the_states_is_told_apart() -> None:
    discovery, bank = discovered("environment", xy)
    settings = dataclasses.replace(discovery.settings, leak=0.0, scale=4.0, start_radius=0.0, goal_radius=0.0)
    discovery = Discovery(settings, kind="environment")
    for trajectory in walks():
        discovery.add(trajectory, xy(np.asarray(trajectory.states, dtype=np.float64)))
    discovery.search()
    shown = np.asarray(patches(maps(discovery, bank)[DENSITY]).get_array())
    assert (shown > shown.min()).mean() >= 0.2


def test_initiation_set_and_arrows_that_lead_to_the_subgoal() -> None:
    discovery, bank = discovered("environment", xy)
    option = bank[0]
    assert isinstance(option, SubgoalOption)
    cells = option.initiation_set.points
    panels = maps(discovery, bank)
    _, sets = (c for c in panels["initiation set"].collections if isinstance(c, PatchCollection))
    assert len(sets.get_paths()) == len(cells)
    (arrows,) = [c for c in panels[POLICY].collections if isinstance(c, Quiver)]
    moves = np.column_stack([arrows.U, arrows.V])
    starts = np.asarray(arrows.get_offsets()) + moves / 2
    assert {tuple(s) for s in starts.round(6)} <= {tuple(c) for c in cells}
    assert len(starts) > 0.7 * len(cells)
    lengths = np.linalg.norm(moves, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0], 0.8, err_msg="however seldom an action succeeds")
    subgoal = discovery.found[0].subgoal.points[0]
    nearer = np.linalg.norm(starts + 0.1 * moves - subgoal, axis=1) < np.linalg.norm(starts - subgoal, axis=1)
    assert nearer.mean() > 0.7


@pytest.mark.parametrize(
    ("kind", "features", "name"),
    [
        ("identity", lambda s: np.column_stack([s, s[:, 0] * s[:, 1]]), "feature 1 of 3"),
        ("given", lambda s: 2.0 * s, "x"),
    ],
    ids=["three", "scaled"],
)
def test_spaces_of_other_sizes(kind: str, features: Callable[[Any], FloatArray], name: str) -> None:
    discovery, bank = discovered(kind, features)
    panels = maps(discovery, bank)
    assert list(panels) == [DENSITY, VISITS, "initiation set", POLICY]
    assert {axes.get_xlabel() for axes in panels.values()} == {name}
    file = io.BytesIO()
    subgoals_figure(discovery, bank).savefig(file, format="png")
    assert n_colours(np.asarray(iio.imread(file.getvalue()))) > 50


@pytest.mark.parametrize(("kind", "features"), [("categorical", one_hot), ("identity", lambda s: s[:, :1])])
def test_spaces_without_a_map(kind: str, features: Callable[[Any], FloatArray]) -> None:
    discovery, bank = discovered(kind, features)
    assert map_figure(discovery, bank) is None
    assert said(discovery) == f"Subgoals: {discovery.found[0].where(kind)}. Their features have no map to draw them in."


def test_before_any_search_there_is_nothing_to_draw() -> None:
    empty = Discovery()
    assert map_figure(empty, OptionBank(4, 2)) is None
    assert said(empty).startswith("No subgoal was discovered: no episode has ended. Train for longer")
    assert said(empty, "Discovery was switched off.") == "Discovery was switched off."


def test_options_by_hand_and_on_groups_of_features_are_left_out() -> None:
    discovery, _ = discovered("environment", xy)
    bank, group = OptionBank(4, 2), FeatureGroup("column", [1])
    column = Region(np.array([[4.0]]), np.ones(1), 0.5, group=group)
    policy = TabularPolicy(np.array([[4.0]]), np.eye(4)[:1])
    bank.add(SubgoalOption(column, column, policy, policy_input="features"))
    bank.add(steady_option())
    assert list(maps(discovery, bank)) == [DENSITY, VISITS]
