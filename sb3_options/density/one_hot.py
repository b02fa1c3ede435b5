"""Diverse density of states without distances, whose one-hot codes are all equally far apart."""

import math

import numpy as np

from sb3_options.density.arrays import FloatArray, IntArray
from sb3_options.density.bags import Bags


def is_one_hot(features: FloatArray) -> bool:
    """Whether features (m, d), d > 1, are one-hot codes."""
    binary = bool(((features == 0.0) | (features == 1.0)).all())
    return features.shape[1] > 1 and binary and bool((features.sum(axis=1) == 1.0).all())


def one_hot_log_density(
    points: FloatArray, scale: float, bags: Bags, negative_strength: float, leak: float
) -> FloatArray:
    """Return `log_diverse_density` of one-hot codes (m, d), without products of features.

    All other states are at the same distance, where p = exp(−2 s²). So a positive bag with n instances has probability
    1 if the state is in it, else λ + (1 − λ) (1 − (1 − p)ⁿ). The result is −inf if the state is in a negative bag at
    full strength.
    """
    log_elsewhere = -2.0 * scale**2
    elsewhere = math.exp(log_elsewhere)
    lengths = np.array(bags.lengths)
    bag_of = np.repeat(np.arange(len(lengths)), lengths)
    counts: IntArray = np.zeros((len(lengths), bags.n_features), dtype=np.int64)
    np.add.at(counts, (bag_of, bags.instances.numpy().argmax(axis=1)), 1)
    counts = counts[:, points.argmax(axis=1)]
    positive, negative = counts[: bags.n_positive] > 0, counts[bags.n_positive :]
    n = lengths[: bags.n_positive]
    with np.errstate(divide="ignore", invalid="ignore"):
        # log(1 − (1 − p)ⁿ), which is log(n p) if p is too small to be told from 0.
        near = np.log(-np.expm1(n * np.log1p(-elsewhere))) if elsewhere > 1e-300 else np.log(n) + log_elsewhere
        not_in_it = np.logaddexp(np.log(leak), np.log1p(-leak) + near)
        of_positive = np.where(positive, 0.0, not_in_it[:, None])
        hit, miss = np.log1p(-negative_strength), np.log1p(-negative_strength * elsewhere)
        of_negative = np.where(negative > 0, negative * hit, 0.0) + (lengths[bags.n_positive :, None] - negative) * miss
    return np.asarray(of_positive.sum(axis=0) + of_negative.sum(axis=0))
