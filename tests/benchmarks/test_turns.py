from benchmarks.turns import take_turns


def test_every_round_another_begins() -> None:
    order: list[str] = []

    def play(name: str) -> int:
        order.append(name)
        return len(order)

    assert take_turns("ab", play, 3) == {"a": [1, 4, 5], "b": [2, 3, 6]}
    assert order == ["a", "b", "b", "a", "a", "b"]
