import copy
import functools
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from sb3_options.checkpoints.tree import decode, encode
from sb3_options.state import TRANSIENT, restore, state_of, storable


@storable
@dataclass(frozen=True)
class Place:
    point: tuple[float, ...]
    n: int = 0


@dataclass(eq=False)
class Inner:
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    numbers: list[int] = field(default_factory=list)


class Plain:
    STATE = ("n",)

    def __init__(self) -> None:
        self.n = 0
        self.cache = 0


class Own:
    def __init__(self) -> None:
        self.n = 0

    def get_state(self) -> dict[str, Any]:
        return {"n": self.n}

    def set_state(self, state: dict[str, Any]) -> None:
        self.n = state["n"] + 100


@dataclass(eq=False)
class Outer:
    rule: Callable[[], int] = field(default=lambda: 1, metadata=TRANSIENT)
    inner: Inner = field(default_factory=Inner)
    members: dict[str, Inner] = field(default_factory=lambda: {"a": Inner(), "b": Inner()})
    last: deque[int] = field(default_factory=lambda: deque(maxlen=2))
    by_slot: dict[int, deque[float]] = field(default_factory=lambda: defaultdict(lambda: deque(maxlen=3)))
    seen: set[int] = field(default_factory=set)
    order: OrderedDict[bytes, int] = field(default_factory=OrderedDict)
    counts: Counter[str] = field(default_factory=Counter)
    places: list[Place] = field(default_factory=list)
    array: Any = field(default_factory=lambda: np.zeros(2))
    network: torch.nn.Module = field(default_factory=lambda: torch.nn.Linear(2, 1))
    drawn: torch.Generator = field(default_factory=torch.Generator)
    plain: Plain = field(default_factory=Plain)
    own: Own = field(default_factory=Own)
    maybe: Inner | None = None

    @functools.cached_property
    def total(self) -> int:
        return sum(self.seen)


def used() -> Outer:
    outer = Outer()
    outer.inner.random.random()
    outer.inner.numbers += [1, 2]
    outer.members["b"].numbers += [3]
    outer.last.extend((4, 5, 6))
    outer.by_slot[1].append(0.5)
    outer.seen |= {7}
    outer.order[b"k"] = 8
    outer.counts["c"] += 9
    outer.places += [Place((1.0,))] * 2
    outer.array = np.arange(3)
    torch.nn.init.constant_(outer.network.weight, 0.25)  # type: ignore[arg-type]  # a parameter
    outer.drawn.manual_seed(5)
    outer.plain.n, outer.plain.cache = 10, 11
    outer.own.n = 12
    assert outer.total == 7
    return outer


def through_a_file(state: dict[str, Any]) -> Any:
    return decode(*encode(state))


def test_fields_come_back_in_place() -> None:
    one, other = used(), Outer()
    parts = other.inner, other.members["b"], other.last, other.by_slot, other.network, other.inner.random
    restore(other, through_a_file(state_of(one)))
    restored = other.inner, other.members["b"], other.last, other.by_slot, other.network, other.inner.random
    assert all(before is after for before, after in zip(parts, restored, strict=True))
    assert other.inner.numbers == [1, 2]
    assert other.members["b"].numbers == [3]
    assert other.last == deque([5, 6])
    assert (other.by_slot[1].maxlen, other.by_slot[2]) == (3, deque())  # the factory stays
    assert (other.seen, other.order, other.counts["c"], other.total) == ({7}, {b"k": 8}, 9, 7)
    assert other.places[0] is other.places[1]
    np.testing.assert_array_equal(other.array, np.arange(3))
    assert other.inner.random.random() == one.inner.random.random()
    assert torch.rand(1, generator=other.drawn) == torch.rand(1, generator=one.drawn)
    assert torch.equal(other.network.weight, one.network.weight)  # type: ignore[arg-type]  # parameters
    assert (other.plain.n, other.plain.cache, other.own.n) == (10, 0, 112)
    assert other.rule is Outer().rule


def test_an_optimizer_comes_back() -> None:
    @dataclass(eq=False)
    class Learner:
        weight: torch.nn.Parameter = field(metadata=TRANSIENT)
        adam: torch.optim.Adam = field(init=False)

        def __post_init__(self) -> None:
            self.adam = torch.optim.Adam([self.weight])

    one, other = (Learner(torch.nn.Parameter(torch.ones(2))) for _ in range(2))
    one.weight.grad = torch.ones(2)
    one.adam.step()
    restore(other, through_a_file(state_of(one)))
    assert torch.equal(other.adam.state[other.weight]["exp_avg"], one.adam.state[one.weight]["exp_avg"])


def test_a_shared_part_is_stored_once_and_stays_shared() -> None:
    shared = Inner()
    one, other = Outer(inner=shared, members={"a": shared}), Outer()
    other.members = {"a": other.inner}
    shared.numbers.append(1)
    restore(other, through_a_file(state_of(one)))
    assert other.members["a"] is other.inner
    assert other.inner.numbers == [1]


def test_refuses_attributes_that_would_be_lost() -> None:
    outer = Outer()
    outer.inner.extra = 1  # type: ignore[attr-defined]  # the test's own
    with pytest.raises(TypeError, match=r"Outer\.inner\.extra is no field of Inner"):
        state_of(outer)


def test_refuses_what_declares_no_state() -> None:
    with pytest.raises(TypeError, match=r"a object cannot be stored: .*, at Outer\.array\[0\]"):
        state_of(Outer(array=[object()]))


@pytest.mark.parametrize("other", [Outer(inner=None), Outer(inner=Outer())])  # type: ignore[arg-type]  # as a file may
def test_refuses_the_state_of_other_parts(other: Outer) -> None:
    with pytest.raises(ValueError, match=r"Outer\.inner is a \w+, and was a Inner"):
        restore(other, state_of(Outer()))


def test_a_state_is_not_emptied_by_going_back_to_it() -> None:
    outer = used()
    state = copy.deepcopy(state_of(outer))
    for _ in range(2):
        outer.inner.numbers.clear()
        restore(outer, state)
        assert outer.inner.numbers == [1, 2]
