"""The study of what papers report: graphs, walks on them, and its parts in short."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from experiments.common.gridworlds import rooms_of
from experiments.published import measures
from experiments.published.__main__ import ROWS, Study, main
from experiments.published.graphs import cover_time, diffusion_time, grid, joined
from experiments.published.learning import moves_of, tasks_of

LINE = csr_array(np.diag(np.ones(2), 1) + np.diag(np.ones(2), -1))
"""Three cells in a row."""


def test_diffusion_time_by_hand() -> None:
    """The mean over the three goals of what a chain of three states takes."""
    chance = np.array([[0.75, 0.25, 0], [0.25, 0.5, 0.25], [0, 0.25, 0.75]])
    times = []
    for goal in range(3):
        others = [i for i in range(3) if i != goal]
        times += np.linalg.solve(np.eye(2) - chance[np.ix_(others, others)], np.ones(2)).tolist()
    assert diffusion_time(LINE, []) == pytest.approx(np.mean(times))


def test_an_option_that_passes_the_goal_reaches_it() -> None:
    right = np.array([1, 2, 2])
    left = np.array([0, 0, 1])
    assert diffusion_time(LINE, [right, left]) < diffusion_time(LINE, [])


def test_cover_time_of_a_line() -> None:
    """4 decisions from an end, 5 from the middle: one to an end, and from there 4 to the other."""
    assert cover_time(LINE, np.random.default_rng(0), 4000) == pytest.approx((4 + 5 + 4) / 3, rel=0.05)
    assert joined(LINE, [(0, 2)]).toarray().sum() == 6


def test_four_eigenoptions_lead_to_four_rooms() -> None:
    _, cells, adjacency = grid("sb3_options/FourRooms-v0")
    assert adjacency.shape == (len(cells), len(cells))
    found = measures.eigenoptions(20, 0)
    assert found["rooms"] == 4
    assert found["diffusion_time"][16] < found["diffusion_time"][0]
    assert found["steps_to_learn"][16][1] < found["steps_to_learn"][0][1]


def test_tasks_lead_from_room_to_room() -> None:
    world, cells, adjacency = grid("sb3_options/FourRooms-v0")
    moves = moves_of(cells)
    assert [set(led) - {i} for i, led in enumerate(moves.tolist())] == [
        set(np.flatnonzero(row).tolist()) for row in adjacency.toarray()
    ]
    tasks = tasks_of(world, cells, 50, np.random.default_rng(0))
    rooms = [[i for i, room in enumerate(rooms_of(world)) if tuple(cells[cell]) in room] for cell in tasks.ravel()]
    assert tasks.shape == (50, 2)
    assert all(len(of) == 1 for of in rooms)
    assert all(start != goal for start, goal in zip(rooms[::2], rooms[1::2], strict=True))


"""Ten cells in a row; two of the four moves lead against walls."""


def test_covering_options_cover_sooner() -> None:
    found = measures.covering(60, 0)
    assert found["covering"][32] < found["eigenoptions"][32] < found["eigenoptions"][0]


def test_taxi_and_walks() -> None:
    assert measures.betweenness() == {
        "states": 400, "maxima": 18, "stops": 8, "navigation": 10, "navigation_cells": {"2,1": 5, "2,2": 5},
    }  # fmt: skip
    assert measures.l_cut(range(1))["within_one_step"] == 1
    assert measures.relative_novelty(range(1), 1)["runs"] == 1


def test_a_row_alone_leaves_the_others(tmp_path: Path) -> None:
    main(Study(out=tmp_path, rows=("l_cut",), runs=1, first_seed=3))
    main(Study(out=tmp_path, rows=("covering",), walks=2, first_seed=4))
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {name: row["command"] for name, row in rows.items()} == {
        "covering": "python -m experiments.published --rows covering --first-seed 4 --walks 2",
        "l_cut": "python -m experiments.published --rows l_cut --runs 1 --first-seed 3",
    }
    assert rows["l_cut"]["within_one_step"] == 1


def test_the_committed_rows_say_what_measured_them() -> None:
    rows = json.loads(Path("docs/results/published.json").read_text())["rows"]
    told = {name: Study(out=Path(), runs=rows[name].get("runs", 50)).command(name) for name in ROWS}
    assert {name: row["command"] for name, row in rows.items()} == told


def test_the_page_has_the_committed_steps_of_learning() -> None:
    page = Path("docs/studies/published.md").read_text()
    row = json.loads(Path("docs/results/published.json").read_text())["rows"]["eigenoptions"]
    quartiles = list(row["steps_to_learn"].values())
    for name, cells in {
        "steps to learn, median": [f"{of[1]:,.0f}" for of in quartiles],
        "lower and upper quartile": [f"{of[0]:,.0f}, {of[2]:,.0f}" for of in quartiles],
        "mean": [f"{of:,.0f}" for of in row["mean_steps_to_learn"].values()],
        "never learned": [f"{of:.2f}" for of in row["never_learned"].values()],
    }.items():
        assert f"| {' | '.join([name, *cells])} |" in page
