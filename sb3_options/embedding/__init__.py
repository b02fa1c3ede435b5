"""Feature maps that are learned from trajectories: nobody has to hand in coordinates."""
