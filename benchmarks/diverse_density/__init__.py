"""Speed and quality of diverse density: ``python -m benchmarks.diverse_density``."""
