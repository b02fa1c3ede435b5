"""Stable-Baselines3 callbacks of sb3-options."""
