"""Finds subgoals in trajectories. Pure."""
