"""What is measured: visits, diverse density, subgoals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from experiments.common.gridworlds import Cell, cell_of
from experiments.paper.settings import PaperSettings
from sb3_options.density.bags import Bags
from sb3_options.density.log_density import log_diverse_density
from sb3_options.discovery.discovery import Discovery
from sb3_options.discovery.methods.diverse_density import PersistentPeaks
from sb3_options.discovery.static_filter import near_start_and_goal
from sb3_options.envs import GridWorld
from sb3_options.experience.observations import FloatArray, IntArray
from sb3_options.experience.success import SuccessRule, reported_success
from sb3_options.experience.trajectories import LabelledTrajectory

LOWEST_LOG_DENSITY = -200.0
"""In place of −∞ before a mean is taken: a negative bag of full strength gives that."""


def visit_counts(world: GridWorld, trajectories: Iterable[LabelledTrajectory], *, first_only: bool) -> IntArray:
    """How often each cell was visited (or in how many trajectories), shape (height, width)."""
    counts = np.zeros((world.height, world.width), dtype=np.int64)
    for labelled in trajectories:
        x, y = labelled.features.astype(np.int64).T
        visits = labelled.trajectory.visits
        np.add.at(counts, (y, x), 1 if first_only else np.bincount(visits, minlength=len(x)))
    return counts


def density_map(world: GridWorld, discovery: Discovery) -> FloatArray | None:
    """Log diverse density of every cell, NaN in walls, shape (height, width); None while there are too few bags."""
    bags = _bags(discovery)
    if bags is None or discovery.scale is None:
        return None
    y, x = np.nonzero(~world.walls)
    points = np.stack([x, y], axis=1).astype(np.float64)
    scales = np.broadcast_to(discovery.scale, points.shape)
    strength = discovery.settings.negative_strength or 1.0  # with 0 there are no negative bags
    values = np.full(world.walls.shape, np.nan)
    values[y, x] = log_diverse_density(points, scales.copy(), bags, negative_strength=strength).numpy()
    floored: FloatArray = np.maximum(values, LOWEST_LOG_DENSITY)
    return floored


def _bags(discovery: Discovery) -> Bags | None:
    assert isinstance(discovery.method, PersistentPeaks)  # the default
    filtered = discovery.method.bags(discovery.experience([*discovery.database][-1]))
    return None if filtered is None else filtered.bags


def discovery_of(
    settings: PaperSettings,
    trajectories: Iterable[LabelledTrajectory],
    *,
    success: SuccessRule = reported_success,
    negative_strength: float | None = None,
    loops: bool = True,
) -> Discovery:
    """Discovery that has seen these trajectories, and not searched."""
    how = settings.discovery(negative_strength=negative_strength, loops=loops)
    discovery = Discovery(how, settings.method() if loops else None, success=success)
    for labelled in trajectories:
        discovery.add(labelled.trajectory, labelled.features)
    return discovery


def first_subgoal(
    settings: PaperSettings,
    trajectories: Sequence[LabelledTrajectory],
    *,
    success: SuccessRule = reported_success,
    negative_strength: float | None = None,
    loops: bool = True,
) -> tuple[int, Cell] | None:
    """Trial and cell of the first subgoal that the callback would have found; None if it finds none.

    The trajectories are those of an agent without options, so this is exact up to the first subgoal.
    """
    discovery = discovery_of(settings, [], success=success, negative_strength=negative_strength, loops=loops)
    for trial, labelled in enumerate(trajectories, start=1):
        added = discovery.add(labelled.trajectory, labelled.features)
        if added.success or discovery.settings.negative_strength > 0:
            subgoal = discovery.search()
            if subgoal is not None:
                return trial, cell_of(subgoal.points[0])
    return None


def most_visited(world: GridWorld, discovery: Discovery, *, first_only: bool, rng: np.random.Generator) -> Cell | None:
    """The baseline: the cell that most trajectories visited (or that was visited most) and that may be a subgoal.

    Args:
        world: The gridworld.
        discovery: Its trajectories are counted, and its static filter is used.
        first_only: First visits, or every visit.
        rng: Breaks ties.

    Returns:
        The cell; None while there are too few trajectories for bags.
    """
    if _bags(discovery) is None or discovery.scale is None:
        return None
    settings = discovery.settings
    static_filter = near_start_and_goal(settings.start_radius, settings.goal_radius)
    counts = np.zeros(world.walls.shape, dtype=np.int64)
    for labelled in discovery.database:
        scaled = labelled.features * discovery.scale
        keep = static_filter(scaled, scaled[0], scaled[labelled.trajectory.visits[-1]])
        x, y = labelled.features.astype(np.int64)[keep].T
        times = np.bincount(labelled.trajectory.visits, minlength=len(labelled.features))[keep]
        np.add.at(counts, (y, x), 1 if first_only else times)
    best = np.argwhere(counts == counts.max())
    y, x = best[int(rng.integers(len(best)))]
    return int(x), int(y)
