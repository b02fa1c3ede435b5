"""Environments and studies on a Ray cluster: ``python -m experiments.cluster``."""
