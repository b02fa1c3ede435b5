from experiments.common.gridworlds import cell_of, counts_of, distance_to_doorway, world_of


def test_where_subgoals_lie() -> None:
    world = world_of("sb3_options/TwoRooms-v0")
    assert cell_of([9.8, 5.2]) == (10, 5)
    assert distance_to_doorway(world, (9, 4)) == 2
    counts = counts_of(world, [(10, 5), None, (10, 5), (0, 1)])
    assert counts.shape == world.walls.shape
    assert (counts[5, 10], counts[1, 0], counts.sum()) == (2, 1, 3)
