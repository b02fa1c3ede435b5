"""From trajectories to subgoals. Pure."""
