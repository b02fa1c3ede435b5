"""Learned spaces: are the subgoals of random walks seen as pictures bottlenecks, without coordinates?"""
