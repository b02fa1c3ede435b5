"""The gridworld results of McGovern & Barto (2001), §3 and §6: ``python -m experiments.paper all --out FOLDER``."""
