"""Proposes groups of features from experience, for a feature map that names none."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from sb3_options.density.arrays import BoolArray, FloatArray
from sb3_options.density.bags import check_finite, real_array
from sb3_options.density.groups import FeatureGroup

PRESENT_SCALE = 10.0  # distance between present and absent, in scaled units: more than any radius

# A thing without coordinates is context if it occurs in this share of the trajectories. An occurrence in every episode
# is no bottleneck, but a policy may need to see it: a wall ahead, for instance.
CONTEXT = 0.9
ROUNDING = 1e-9  # changes smaller than this share of a feature's largest value are rounding errors
REPLACED = 0.25  # a thing takes the place of another if that one disappears in this share of its appearances


def propose_groups(trajectories: Sequence[FloatArray], names: Sequence[str] = ()) -> tuple[FeatureGroup, ...]:
    """Propose the groups of features that make a concept together.

    A feature that is 0 or one other number says whether a thing is present. Features with more values that are 0
    whenever the thing is absent are its coordinates. Each thing makes a group, and so do two located things that occur
    together. An option also sees the things that occur in nearly all trajectories. An option to one thing also sees the
    thing that it most often replaces: a closed door, if it is an open one.

    Args:
        trajectories: φ of the observations of each trajectory in order of time, such as random walks, (T + 1, d) each.
        names: Names of the d features, for descriptions.

    Returns:
        The groups; none if no feature says whether a thing is present.

    Raises:
        ValueError: There is no trajectory, features are not finite, or numbers of features or names differ.
    """
    walks = [real_array(f"trajectory {i}", each) for i, each in enumerate(trajectories)]
    shapes = {walk.shape[1:] for walk in walks if walk.ndim == 2 and len(walk)}
    if len(shapes) != 1 or any(walk.shape[1:] not in shapes for walk in walks):
        raise ValueError("trajectories must hold at least one array of features (T + 1, d), d equal in all")
    features = np.concatenate(walks)
    check_finite("trajectories", features)
    names = list(names) or [f"feature {i}" for i in range(features.shape[1])]
    if len(names) != features.shape[1]:
        raise ValueError(f"names must name {features.shape[1]} features, got {len(names)}")
    coordinates = _coordinates(features)
    context = [
        thing
        for thing, of in coordinates.items()
        if not of and np.mean([walk[:, thing].any() for walk in walks]) >= CONTEXT
    ]
    units = _units(walks, features)

    def group(concept: tuple[int, ...]) -> FeatureGroup:
        name = " and ".join(names[thing] for thing in concept)
        own = [i for thing in concept for i in (thing, *coordinates[thing])]
        before = _replaced(concept[0], coordinates, walks) if len(concept) == 1 else []
        others = [i for thing in (*before, *context) for i in (thing, *coordinates[thing])]
        there = [[*concept, *before]] if before else [[thing] for thing in concept]
        located = [i for thing in (*concept, *before) for i in coordinates[thing]]
        seen = FeatureGroup(name, own + others, there, units[own + others].tolist(), coordinates=located)
        labels = ["" if i in coordinates else names[i] for i in own]
        return FeatureGroup(name, own, [[thing] for thing in concept], units[own].tolist(), seen, labels=labels)

    things = [thing for thing in coordinates if thing not in context]
    located = [thing for thing in things if coordinates[thing]]
    together = [pair for pair in combinations(located, 2) if features[:, pair].all(axis=1).any()]
    return tuple(map(group, [*((thing,) for thing in things), *together]))


def _coordinates(features: FloatArray) -> dict[int, list[int]]:
    """Return for each feature that says whether a thing is present the features that locate it."""
    there = features != 0
    n_values = [len(np.unique(column)) for column in features.T]
    n_there = there.sum(axis=0)
    things: dict[int, list[int]] = {i: [] for i, n in enumerate(n_values) if n == 2 and 0 < n_there[i] < len(features)}
    for i, n in enumerate(n_values):
        owners = [thing for thing in things if not (there[:, i] & ~there[:, thing]).any()]
        if n > 2 and owners:
            # Feature maps list a thing before its coordinates. Otherwise the rarest thing is the likeliest.
            before = max((thing for thing in things if thing < i), default=None)
            things[before if before in owners else min(owners, key=n_there.__getitem__)].append(i)
    return things


def _units(walks: Sequence[FloatArray], features: FloatArray) -> FloatArray:
    """Return a scale per feature, (d,): ``PRESENT_SCALE`` for a thing, else one over a small change in one step."""
    values = np.abs(features).max(axis=0)
    changes = np.abs(np.concatenate([np.diff(walk, axis=0) for walk in walks]))
    units = np.ones(features.shape[1])
    for i, (value, change) in enumerate(zip(values, changes.T, strict=True)):
        if len(np.unique(features[:, i])) == 2:
            units[i] = PRESENT_SCALE / value
        elif (moves := change > ROUNDING * value).any():
            units[i] = 1 / np.quantile(change[moves], 0.25)
    return units


def _replaced(thing: int, coordinates: dict[int, list[int]], walks: Sequence[FloatArray]) -> list[int]:
    """Return the located thing that most often disappears as this one appears, if that is often enough."""

    def ends(number: int, *, appears: bool) -> BoolArray:
        there = [walk[:, number] != 0 for walk in walks]
        return np.concatenate([(each[1:] == appears) & (each[:-1] != appears) for each in there])

    appears = ends(thing, appears=True)
    shares = {
        other: (appears & ends(other, appears=False)).sum() / max(1, appears.sum())
        for other, of in coordinates.items()
        if of and other != thing
    }
    most = max(shares, key=shares.__getitem__, default=None)
    return [most] if most is not None and shares[most] >= REPLACED else []
