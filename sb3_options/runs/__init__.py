"""A run of `train.py`: its settings, its folder, its evaluation; needs the extra ``train``."""
