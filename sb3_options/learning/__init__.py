"""Stable-Baselines3 learns over options."""
