"""Options: learned from trajectories, stored and loaded. Pure."""
