import numpy as np
import pytest

from sb3_options import propose_groups
from sb3_options.density.arrays import FloatArray
from sb3_options.density.groups import FeatureGroup
from sb3_options.envs.minigrid import make
from sb3_options.envs.minigrid.retina import feature_names
from sb3_options.execution.wrapper import OptionsWrapper

# A key that is in view or not, at a distance; a door that closes as a gate opens; a wall that everyone meets.
KEY, DISTANCE, DOOR, AT, GATE, GATE_AT, WALL, CONSTANT, HEIGHT = range(9)
NAMES = ("key", "distance", "door", "at", "gate", "gate at", "wall", "constant", "height")


def walks() -> list[FloatArray]:
    walk = np.zeros((12, 9))
    walk[2:7, KEY], walk[2:7, DISTANCE] = 1.0, [4, 3, 2, 1, 0]
    walk[:6, DOOR], walk[:6, AT] = 2.0, [1, 2, 3, 4, 5, 0]
    walk[6:, GATE], walk[6:, GATE_AT] = 1.0, [0, 1, 2, 4, 5, 6]
    walk[::3, WALL] = 1.0
    walk[:, CONSTANT] = 5.0
    walk[:, HEIGHT] = np.linspace(-1, 1, 12)
    return [walk, walk[::-1].copy()]


def by_name(groups: tuple[FeatureGroup, ...]) -> dict[str, FeatureGroup]:
    return {group.name: group for group in groups}


def test_a_thing_and_its_coordinates_make_a_group() -> None:
    groups = by_name(propose_groups(walks(), NAMES))
    assert {name: group.features for name, group in groups.items()} == {
        "key": (KEY, DISTANCE), "door": (DOOR, AT), "gate": (GATE, GATE_AT),
        "key and door": (KEY, DISTANCE, DOOR, AT), "key and gate": (KEY, DISTANCE, GATE, GATE_AT),
    }  # fmt: skip
    assert groups["door"].present == ((DOOR,),)
    assert groups["key and gate"].present == ((KEY,), (GATE,))
    assert groups["door"].scale == (5.0, 1.0)  # the door is 0 or 2
    assert groups["key"].told(np.array([1.0, 3.0])) == "key at distance 3"


def test_an_option_sees_context_and_what_its_thing_replaces() -> None:
    gate = by_name(propose_groups(walks(), NAMES))["gate"].sees
    assert gate.features == (GATE, GATE_AT, DOOR, AT, WALL)
    assert gate.present == ((GATE, DOOR),)
    assert gate.coordinates == (GATE_AT, AT)


def test_a_thing_without_coordinates_that_is_rare_is_a_concept() -> None:
    seldom = [walk for _ in range(10) for walk in walks()]
    for walk in seldom[2:]:
        walk[:, WALL] = 0.0
    wall = by_name(propose_groups(seldom, NAMES))["wall"]
    assert wall.features == (WALL,)
    assert wall.told(np.array([1.0])) == "wall"


def test_without_things_there_are_no_groups() -> None:
    assert propose_groups([np.linspace(0, 1, 10)[:, None], np.ones((3, 1))]) == ()


def test_rounding_is_no_change() -> None:
    walk = np.zeros((8, 2))
    walk[1:7, 0], walk[1:7, 1] = 1.0, [0.1, 0.3, 0.1 + 0.2, 0.3, 0.5, 0.4]
    (group,) = propose_groups([walk])
    assert group.scale is not None
    assert group.scale[1] < 20


def test_the_proposal_for_things_in_minigrid_equals_its_groups() -> None:
    env = OptionsWrapper(make("MiniGrid-MultiRoom-N2-S4-v0", asked=False))
    features = [env.concept_features(walk.states)[walk.visits] for walk in env.random_trajectories(40, 400, 0)]
    proposed = by_name(propose_groups(features, feature_names()))
    made = {group["name"]: group for group in env.get_wrapper_attr("concept_groups")()}
    for kind in ("closed_door", "open_door", "goal"):
        ours = proposed[f"{kind}_visible"]
        assert ours.features == tuple(made[kind]["features"])
        assert ours.scale == tuple(made[kind]["scale"])
        assert set(ours.sees.features) >= set(made[kind]["seen"]["features"])


@pytest.mark.parametrize(
    ("trajectories", "names", "message"),
    [
        ([], (), "at least one array"),
        ([np.zeros(3)], (), "at least one array"),
        ([np.zeros((3, 2)), np.zeros((3, 1))], (), "d equal in all"),
        ([np.full((3, 2), np.nan)], (), "trajectories holds NaN"),
        ([np.zeros((3, 2))], ("one",), "names must name 2 features, got 1"),
        ([np.array([["a"]])], (), "trajectory 0 must hold real numbers"),
    ],
)
def test_bad_input(trajectories: list[FloatArray], names: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        propose_groups(trajectories, names)
