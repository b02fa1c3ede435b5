"""The shipped maps and their step limits.

A step limit is so long that an agent that moves uniformly at random still reaches the goal in at least nine
episodes of ten: a learner without any skill gets its first rewards, and few of its early episodes are cut
off. The figures beside the limits are exact (powers of the random walk's transition matrix) and a test
recomputes them.
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

Start anywhere in the left room, goal in the lower right corner, doorway at (10, 5): the text gives the size,
the rooms, the starts and the goal; the doorway's row is ours. Moving the goal to (20, 0) and lowering the
success probability to 0.8 makes the paper's transfer task.
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

Start anywhere in the upper left room, goal in the lower right room's far corner (11, 11): two ways lead
there, each through two of the four hallways (6, 3), (2, 6), (9, 7) and (6, 10). Their moves succeed with
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

Start anywhere in the left room without the key, which lies in the room's lower left corner; the door at (6,
3) lets only a holder of the key through to the right room, with the goal in its lower right corner.
"""

TWO_ROOMS_MAX_STEPS = 6_000
"""Primitive steps; 91.6 % of random walks arrive within them, half of all random walks within 1,964."""

FOUR_ROOMS_MAX_STEPS = 3_000
"""Primitive steps; 94.6 % of random walks arrive within them, half of all random walks within 843."""

KEY_DOOR_MAX_STEPS = 3_000
"""Primitive steps; 92.9 % of random walks arrive within them, half of all random walks within 1,096."""
