"""Ways to treat noisy negative bags: ``python -m experiments.noisy_bags``."""
