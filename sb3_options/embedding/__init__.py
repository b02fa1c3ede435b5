"""Feature maps learned from trajectories, so that nobody has to supply coordinates."""
