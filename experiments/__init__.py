"""The studies: ``python -m experiments.NAME --out FOLDER``."""
