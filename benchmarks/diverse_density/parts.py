"""The measurements of `benchmarks.diverse_density.__main__`, one function each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from rich.progress import track

from benchmarks.diverse_density.classifier import BagStatisticsForest, DiverseDensityClassifier
from benchmarks.diverse_density.data import LabelledBags, uneven
from benchmarks.diverse_density.references import BagByBag, Vectorised, descend, descend_pruned
from benchmarks.diverse_density.scales import FromScales
from sb3_options.density.arrays import BoolArray, FloatArray
from sb3_options.density.bags import Bags
from sb3_options.density.concepts import Point
from sb3_options.density.diverse_density import FINAL_STEPS, FIRST_STEPS, DiverseDensity
from sb3_options.density.log_density import log_diverse_density
from sb3_options.runs.intervals import mean_interval

UNBOUNDED = Point(scale_bounds=(0, math.inf), prior_width=None)
"""The likelihood alone, as the references compute it."""

START_SCALE = 0.1
MORE_START_SCALES = (0.05, 0.1, 0.2, 0.5, 1.0)
JITTER, GOOD = 0.02, 15.2
"""Standard deviation of what is added to starts, in standard deviations of the features; a value worth finding."""

FINALISTS = (8, 16, 32, 51, 104, 207)
"""The last is all starts: none is dropped."""

COMPILED_FINALISTS = 104
"""The fewest of `FINALISTS` with which the compiled rival finds a good value every time."""

TOLERANCE = 1e-6
"""Relative, of the timed search: 1.5e-5 nats, well within the 1e-4 in which both must agree."""

SAME = 1e-4
SCIPY_BEST = 15.2798
"""Negative log likelihood that scipy reached from all starts at scale 0.1 before this search was written."""

FOLDS, INNER_FOLDS = 10, 3
EM_DD = {
    "accuracy": 0.848,
    "source": "Andrews, Tsochantaridis & Hofmann 2002, table 1: ten-fold, scored on unseen bags",
}

BagClassifier = DiverseDensityClassifier | BagStatisticsForest
CANDIDATES: list[dict[str, Any]] = [
    {"steps": steps, "start_scales": scales} for steps in (10, 20, 40) for scales in ((0.25, 0.5), (0.5, 1.0))
]
DIMENSIONS = (2, 8, 16, 64)
N_STARTS = 128
EDGE = 1024
N_EXPONENTIALS = 1 << 17


def seconds(work: Callable[[], Any]) -> float:
    """Processor time of this single-threaded process: other work on the machine does not count."""
    began = time.process_time()
    work()
    return time.process_time() - began


def against_references(data: LabelledBags, rounds: int, loop_starts: int) -> dict[str, Any]:
    """Time to the best of all starts on Musk1, ours and the references', taking turns.

    Every round runs our whole search and the two rivals that prune like it, the vectorised reference from its share of
    the starts, and the bag-by-bag reference from a few; times of parts are scaled up to all starts.
    """
    from benchmarks.diverse_density.compiled import Compiled

    data = data.standardised()
    starts = np.concatenate(data.positive)
    bags = Bags.pack(data.positive, data.negative)
    quick = FromScales(concept=UNBOUNDED, start_scales=(START_SCALE,), max_starts=None, tolerance=TOLERANCE)
    vectorised, loop = Vectorised(data.positive, data.negative), BagByBag(data.positive, data.negative)
    check = _agreement(starts[0], bags, vectorised, loop)
    rival = Compiled(data.positive, data.negative)
    settings = {"first_steps": FIRST_STEPS, "final_steps": FINAL_STEPS, "tolerance": TOLERANCE}

    def compiled() -> None:
        found = rival.search(starts, START_SCALE, finalists=COMPILED_FINALISTS, **settings)  # type: ignore[arg-type]
        a, s = np.split(found, 2)
        best["compiled"] = min(best["compiled"], vectorised(np.concatenate([a / s, s]))[0])

    def pruned() -> None:
        found = descend_pruned(vectorised, starts, START_SCALE, quick.finalists, FIRST_STEPS)
        best["pruned"] = min(best["pruned"], found.value)

    best = dict.fromkeys(("ours", "compiled", "pruned", "vectorised", "bag_by_bag"), math.inf)
    quick.search(bags)
    compiled()  # and so does numba its work before the first turn
    times: dict[str, list[float]] = {name: [] for name in best}
    order = np.random.default_rng(0).permutation(len(starts))

    def ours() -> None:
        best["ours"] = min(best["ours"], -quick.search(bags)[0].log_density)

    def reference(name: str, objective: Vectorised | BagByBag, numbers: FloatArray) -> None:
        for i in numbers:
            best[name] = min(best[name], descend(objective, starts[int(i)], START_SCALE).value)

    for turn, share in enumerate(track(np.array_split(order, rounds), description="Musk1, speed")):
        few = share[:loop_starts]
        times["ours"].append(seconds(ours))
        times["compiled"].append(seconds(compiled))
        times["pruned"].append(seconds(pruned))
        times["vectorised"].append(seconds(lambda s=share: reference("vectorised", vectorised, s)))  # type: ignore[misc]
        times["vectorised"][turn] *= len(starts) / len(share)
        times["bag_by_bag"].append(seconds(lambda s=few: reference("bag_by_bag", loop, s)))  # type: ignore[misc]
        times["bag_by_bag"][turn] *= len(starts) / len(few)
    exact = FromScales(concept=UNBOUNDED, start_scales=(START_SCALE,), max_starts=None).search(bags)
    several = FromScales(concept=UNBOUNDED, start_scales=MORE_START_SCALES, max_starts=None).search(bags)
    result: dict[str, Any] = {
        "n_starts": len(starts),
        "rounds": rounds,
        "error_against_log_diverse_density": check,
        "best_nll": {**best, "ours_to_rest": -exact[0].log_density, "ours_several_scales": -several[0].log_density},
        "best_nll_at_one_scale": {"value": best["ours"], "bar": SCIPY_BEST, "reached": best["ours"] <= SCIPY_BEST},
        "several_scales": list(MORE_START_SCALES),
        "seconds": {name: float(np.median(t)) for name, t in times.items()},
    }
    for name, bar in (("compiled", 1.0), ("pruned", 1.0), ("vectorised", 25.0), ("bag_by_bag", 200.0)):
        ratio = mean_interval(np.array(times[name]) / np.array(times["ours"]))
        reached = ratio.mean >= bar and best["ours"] <= best[name] + SAME
        result[f"times_faster_than_{name}"] = {**ratio._asdict(), "bar": bar, "reached": reached}
    return result


def quality(data: LabelledBags, runs: int) -> dict[str, Any]:
    """What the number of finalists costs and is worth: negative log likelihoods on Musk1 from jittered starts."""
    from benchmarks.diverse_density.compiled import Compiled

    data = data.standardised()
    starts, bags = np.concatenate(data.positive), Bags.pack(data.positive, data.negative)
    rival, objective = Compiled(data.positive, data.negative), Vectorised(data.positive, data.negative)

    def ours(points: FloatArray, finalists: int) -> float:
        search = FromScales(
            concept=UNBOUNDED, start_scales=(START_SCALE,), max_starts=None, tolerance=TOLERANCE, finalists=finalists
        )
        return -search.search(bags, starts=points)[0].log_density

    def compiled(points: FloatArray, finalists: int) -> float:
        found = rival.search(
            points,
            START_SCALE,
            finalists=finalists,
            first_steps=FIRST_STEPS,
            final_steps=FINAL_STEPS,
            tolerance=TOLERANCE,
        )
        a, s = np.split(found, 2)
        return objective(np.concatenate([a / s, s]))[0]

    result: dict[str, Any] = {"runs": runs, "jitter": JITTER, "good": GOOD}
    compiled(starts, FINALISTS[0])  # numba does its work
    for name, contestant in (("ours", ours), ("compiled", compiled)):
        for finalists in FINALISTS:
            values, times = [], []
            for seed in track(range(runs), description=f"Musk1, {name}, {finalists} finalists"):
                points = starts + JITTER * np.random.default_rng(seed).normal(size=starts.shape)
                began = time.process_time()
                values.append(contestant(points, finalists))
                times.append(time.process_time() - began)
            result[f"{name}_{finalists}"] = {
                "share_good": float(np.mean(np.array(values) < GOOD)),
                "quartiles": np.quantile(values, [0, 0.25, 0.5, 0.75, 1]).tolist(),
                "median_seconds": float(np.median(times)),
            }
    return result


def _agreement(point: FloatArray, bags: Bags, *references: Vectorised | BagByBag) -> float:
    """Largest error of the references against the library's most exact function, value and gradient."""
    theta = np.concatenate([point + 0.1, np.full_like(point, START_SCALE)])
    t, s = (torch.from_numpy(part.copy())[None].requires_grad_() for part in np.split(theta, 2))
    value = log_diverse_density(t, s, bags)
    gradient = torch.cat(torch.autograd.grad(-value, [t, s]), 1)[0].numpy()
    errors = []
    for reference in references:
        other, slope = reference(theta)
        errors += [abs(other + value.item()), float(np.abs(slope - gradient).max())]
    return max(errors)


def kernel(rounds: int, seed: int) -> dict[str, Any]:
    """Nanoseconds per (start, instance) of value and gradient, beside two bare kernels in the same rounds.

    A matrix product for the 4 d multiply-adds and one exponential: what the evaluation would take if it were these
    two library calls alone. It is no bound on what a machine can do: kernels fused with the product could be faster.
    """
    rng = np.random.default_rng(seed)
    work: dict[int, tuple[Callable[[], Any], int]] = {}
    for d in DIMENSIONS:
        data = uneven(rng, d)
        search = DiverseDensity(concept=Point(prior_width=None))
        evidence = search.evidence(Bags.pack(data.positive, data.negative))
        points = np.concatenate(data.positive)[rng.permutation(sum(map(len, data.positive)))[:N_STARTS]]
        theta = search.concept.start(torch.from_numpy(evidence.scaled(points)), 0.7 / math.sqrt(d)).float()
        work[d] = (lambda e=evidence, th=theta: e.loss(th)), sum(map(len, data.bags)) * N_STARTS  # type: ignore[misc]
    left, right, out = torch.randn(EDGE, EDGE), torch.randn(EDGE, EDGE), torch.empty(EDGE, EDGE)
    exponents, powers = -20 * torch.rand(N_EXPONENTIALS), torch.empty(N_EXPONENTIALS)
    nanoseconds: dict[int, list[float]] = {d: [] for d in DIMENSIONS}
    kernels: dict[int, list[float]] = {d: [] for d in DIMENSIONS}
    for turn in track(range(rounds + 1), description="Kernel"):
        product = min(seconds(lambda: torch.mm(left, right, out=out)) for _ in range(2)) / EDGE**3
        exponential = _best(lambda: torch.exp2(exponents, out=powers)) / N_EXPONENTIALS
        for d, (evaluation, pairs) in work.items():
            taken = _best(evaluation) / pairs
            if turn:  # the first round fills caches
                nanoseconds[d].append(1e9 * taken)
                kernels[d].append(1e9 * (4 * d * product + exponential))
    result: dict[str, Any] = {}
    for d, bar in zip(DIMENSIONS, (0.20, 0.40, 0.45, 0.65), strict=True):
        share = mean_interval(np.array(kernels[d]) / np.array(nanoseconds[d]))
        result[str(d)] = {
            "nanoseconds": float(np.median(nanoseconds[d])),
            "two_kernels_nanoseconds": float(np.median(kernels[d])),
            "two_kernels_share": {**share._asdict(), "bar": bar, "reached": share.mean >= bar},
        }
    return result


def _best(work: Callable[[], Any], repeats: int = 5) -> float:
    return min(seconds(work) for _ in range(repeats))


def cross_validation(data: LabelledBags, repetitions: int, nested: int) -> dict[str, Any]:
    """Repeated stratified cross-validation on Musk1.

    First of `DiverseDensityClassifier` as it comes, nothing chosen on the data. Then ``nested`` times with steps and
    scales chosen from `CANDIDATES` by an inner cross-validation on the training bags of every fold.
    """
    result: dict[str, Any] = {"repetitions": repetitions, "folds": FOLDS}
    runs = [_out_of_fold(data, seed, FOLDS, _as_it_comes) for seed in track(range(repetitions), "Musk1, folds")]
    scores = _scores(runs, data.labels)
    for name, bar in (("accuracy", 0.875), ("auc", 0.915)):
        result[name] = {**scores[name], "bar": bar, "reached": scores[name]["mean"] >= bar}
    runs = [
        _out_of_fold(data, seed, FOLDS, lambda _, s=seed: BagStatisticsForest(s))  # type: ignore[misc]
        for seed in track(range(repetitions), "Musk1, random forest")
    ]
    result["random_forest"] = _scores(runs, data.labels)
    result["published_em_dd"] = EM_DD
    runs = [_out_of_fold(data, seed, FOLDS, _chosen_within) for seed in track(range(nested), "Musk1, nested")]
    if runs:
        result["nested"] = {"repetitions": nested, "candidates": CANDIDATES, **_scores(runs, data.labels)}
    return result


def _scores(runs: list[FloatArray], labels: BoolArray) -> dict[str, dict[str, float]]:
    """Mean and, over several repetitions, standard deviation of accuracy and area under the curve."""
    values = {
        "accuracy": [float(np.mean((positive >= 0.5) == labels)) for positive in runs],
        "auc": [area_under_curve(positive, labels) for positive in runs],
    }
    return {
        name: {"mean": float(np.mean(v)), **({"sd": float(np.std(v, ddof=1))} if len(v) > 1 else {})}
        for name, v in values.items()
    }


def _as_it_comes(_: LabelledBags) -> DiverseDensityClassifier:
    return DiverseDensityClassifier()


def _chosen_within(train: LabelledBags) -> DiverseDensityClassifier:
    """The candidate with the best area under the curve in a cross-validation within the training bags."""
    candidates = [DiverseDensityClassifier(**settings) for settings in CANDIDATES]
    areas = [
        area_under_curve(_out_of_fold(train, 0, INNER_FOLDS, lambda _, c=c: c), train.labels)  # type: ignore[misc]
        for c in candidates
    ]
    return candidates[int(np.argmax(areas))]


def _out_of_fold(
    data: LabelledBags, seed: int, folds: int, make: Callable[[LabelledBags], BagClassifier]
) -> FloatArray:
    """Probability that each bag is positive from a classifier fitted without its fold, folds stratified."""
    rng = np.random.default_rng(seed)
    fold = np.empty(len(data.labels), dtype=np.int64)
    for label in (False, True):
        members = rng.permutation(np.flatnonzero(data.labels == label))
        fold[members] = np.arange(len(members)) % folds
    positive = np.empty(len(data.labels))
    for number in range(folds):
        train, test = np.flatnonzero(fold != number), np.flatnonzero(fold == number)
        training = LabelledBags([data.bags[i] for i in train], data.labels[train])
        classifier = make(training).fit(training.bags, training.labels)
        positive[test] = classifier.predict_proba([data.bags[i] for i in test])[:, 1]
    return positive


def area_under_curve(score: FloatArray, labels: FloatArray | BoolArray) -> float:
    """Probability that a positive scores above a negative, ties counting half."""
    above = score[labels.astype(bool)][:, None] - score[~labels.astype(bool)]
    return float(np.mean((above > 0) + 0.5 * (above == 0)))
