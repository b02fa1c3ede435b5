"""What was lived through: observations, trajectories, how they are recorded and which succeeded. Pure."""
