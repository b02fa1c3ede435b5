"""Environments with bottlenecks; importing this module registers them under ``sb3_options/``."""
