"""Feature maps that are learned from trajectories, so that nobody has to hand in coordinates."""
