"""Experience: observations, trajectories, runs of options, and success. Pure."""
