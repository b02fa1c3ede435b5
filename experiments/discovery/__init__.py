"""The main job over many seeds: ``python -m experiments.discovery``."""
