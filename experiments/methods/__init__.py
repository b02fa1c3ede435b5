"""Methods of discovery against each other, with options learned in one way: ``python -m experiments.methods``."""
