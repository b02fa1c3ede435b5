"""What a new user meets first, over many seeds: ``python -m experiments.first_hour``."""
