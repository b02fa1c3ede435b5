"""Runs of `train.py`: settings, folder and evaluation. Needs the extra ``train``."""
