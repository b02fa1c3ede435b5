"""Save and restore the whole state of a training."""
