"""Diverse density by its definition, with 60 digits and more, and bags to compare on."""

from collections.abc import Sequence
from decimal import MIN_EMIN, Decimal, localcontext

import numpy as np
from numpy.typing import ArrayLike

from sb3_options.density.arrays import FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.log_density import log_diverse_density

# A bag's probability of a miss is rounded once, so a log density near 0 carries the rounding of 1.
ROUNDING = 1e-14


def oracle(
    point: ArrayLike,
    scale: ArrayLike,
    positive: Sequence[FloatArray],
    negative: Sequence[FloatArray] = (),
    strength: float = 1.0,
) -> Decimal:
    """Log diverse density by its definition, with as many digits as exp(−D) needs."""
    with localcontext() as context:
        context.prec, context.Emin = 60, MIN_EMIN
        t, s = (np.broadcast_to(np.asarray(v, float), np.shape(point)).tolist() for v in (point, scale))

        def p(instance: FloatArray) -> Decimal:
            terms = zip(t, s, instance.tolist(), strict=True)
            return (-sum(((Decimal(b) * (Decimal(x) - Decimal(a))) ** 2 for a, b, x in terms), Decimal(0))).exp()

        total = Decimal(0)
        for bag in positive:
            probabilities = [p(x) for x in bag]
            digits_lost = -max(probabilities).adjusted()
            if digits_lost > 1000:
                total += sum(probabilities, Decimal(0)).ln()  # the rest is smaller by a factor of 10^1000
                continue
            context.prec = 60 + digits_lost
            miss = Decimal(1)
            for probability in probabilities:
                miss *= 1 - probability
            hit = 1 - miss
            context.prec = 60
            total += (+hit).ln()
        for bag in negative:
            for x in bag:
                miss = 1 - Decimal(strength) * p(x)
                total += miss.ln() if miss else Decimal("-Infinity")
        return total


def random_bags(rng: np.random.Generator, n: int, d: int, spread: float) -> list[FloatArray]:
    return [rng.normal(scale=spread, size=(rng.integers(1, 6), d)) for _ in range(n)]


def density(
    points: ArrayLike,
    scale: ArrayLike,
    positive: Sequence[FloatArray],
    negative: Sequence[FloatArray] = (),
    eta: float = 1.0,
) -> FloatArray:
    value = log_diverse_density(points, scale, Bags.pack(positive, negative), negative_strength=eta)
    return np.asarray(value.numpy())


ONE = np.zeros((1, 2))
