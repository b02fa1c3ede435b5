"""The shipped maps and their step limits.

Each step limit is so long that a uniformly random walk reaches the goal in at least nine of ten episodes. So an
unskilled learner gets its first rewards, and few of its early episodes are cut off. The figures beside the limits are
exact (powers of the random walk's transition matrix). A test recomputes them.
"""

TWO_ROOMS = """
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS...........
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS#..........
SSSSSSSSSS#.........G
"""
"""The 21x10 gridworld of McGovern & Barto (2001), figure 1A and §6.1.

The start is anywhere in the left room, the goal in the lower right corner, the doorway at (10, 5). The paper's text
gives the size, the rooms, the starts and the goal; the doorway's row is ours. The paper's transfer task moves the goal
to (20, 0) and lowers the success probability to 0.8.
"""

FOUR_ROOMS = """
#############
#SSSSS#.....#
#SSSSS#.....#
#SSSSS......#
#SSSSS#.....#
#SSSSS#.....#
##.####.....#
#.....###.###
#.....#.....#
#.....#.....#
#...........#
#.....#....G#
#############
"""
"""The four rooms of Sutton, Precup & Singh (1999), figure 2.

The start is anywhere in the upper left room, the goal in the lower right room's far corner (11, 11). Two ways lead
there, each through two of the four hallways (6, 3), (2, 6), (9, 7) and (6, 10). In the paper moves succeed with
probability 2/3 and go in each other direction with 1/9, which is ``success_probability=5 / 9`` here.
"""

KEY_DOOR = """
SSSSSS#......
SSSSSS#......
SSSSSS#......
SSSSSSD......
SSSSSS#......
SSSSSS#......
SSSSSS#......
KSSSSS#.....G
"""
"""Find a key to open a door: the further example of McGovern & Barto (2001), §3, as a 13x8 gridworld of ours.

The start is anywhere in the left room, without the key, which lies in the room's lower left corner. Only a holder of
the key can pass the door at (6, 3) to the right room, which has the goal in its lower right corner.
"""

TWO_ROOMS_MAX_STEPS = 6_000
"""Primitive steps; 91.6 % of random walks arrive within them, half of all random walks within 1,964."""

FOUR_ROOMS_MAX_STEPS = 3_000
"""Primitive steps; 94.6 % of random walks arrive within them, half of all random walks within 843."""

KEY_DOOR_MAX_STEPS = 3_000
"""Primitive steps; 92.9 % of random walks arrive within them, half of all random walks within 1,096."""
