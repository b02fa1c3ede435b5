"""The study of what papers report: graphs, walks on them, and its parts in short."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from experiments.published import measures
from experiments.published.__main__ import Study, main
from experiments.published.graphs import diffusion_time

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


def test_covering_options_cover_sooner() -> None:
    found = measures.covering(60, 0)
    assert found["covering"][32] < found["eigenoptions"][32] < found["eigenoptions"][0]


def test_a_row_alone_leaves_the_others(tmp_path: Path) -> None:
    main(Study(out=tmp_path, rows=("l_cut",), runs=1, first_seed=3))
    main(Study(out=tmp_path, rows=("covering",), walks=2, first_seed=4))
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {name: row["command"] for name, row in rows.items()} == {
        "covering": "python -m experiments.published --rows covering --first-seed 4 --walks 2",
        "l_cut": "python -m experiments.published --rows l_cut --runs 1 --first-seed 3",
    }
    assert rows["l_cut"]["within_one_step"] == 1
