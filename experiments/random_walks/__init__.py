"""Random walks: are the subgoals that discovery finds bottlenecks?"""
