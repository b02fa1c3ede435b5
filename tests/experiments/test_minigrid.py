import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.minigrid import agents, settings
from experiments.minigrid.__main__ import Study, main
from experiments.minigrid.conditions import stages_of
from experiments.minigrid.hand_made import FORWARD, LEFT, RIGHT, TOGGLE, approach
from experiments.minigrid.settings import ARMS, FAMILIES, Stage
from experiments.minigrid.summary import frames_to, summarise
from sb3_options import OptionsWrapper
from sb3_options.envs.minigrid import FEATURES


def test_study_writes_results_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stage("MiniGrid-Empty-5x5-v0", 600), Stage("MiniGrid-MultiRoom-N2-S4-v0", 600)
    monkeypatch.setitem(FAMILIES, "small", stages)
    monkeypatch.setattr(settings, "N_ENVS", 2)
    monkeypatch.setattr(settings, "EPISODES", 2)
    monkeypatch.setitem(settings.PPO, "n_steps", 64)
    monkeypatch.setitem(settings.PPO, "batch_size", 64)
    main(Study(out=tmp_path, runs=1, first_seed=0, jobs=1, family="small"))
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written["summary"]["arms"]) == set(ARMS)
    assert set(written["summary"]["uniform"]) == {"discovered", "hand-made"}
    assert [len(written["runs"][arm][0]["stages"]) for arm in ARMS] == [2, 2, 2, 1]
    assert (tmp_path / "minigrid.png").stat().st_size > 5_000


def test_all_agents_get_the_same_frames() -> None:
    for family in FAMILIES:
        frames = {arm: sum(stage.frames for stage in stages_of(family, arm)) for arm in ARMS}
        assert len(set(frames.values())) == 1
        assert {stages_of(family, arm)[-1].env_id for arm in ARMS} == {FAMILIES[family][-1].env_id}


def features(**values: float) -> Any:
    row = np.zeros((1, len(FEATURES)))
    for name, value in values.items():
        row[0, FEATURES.index(name)] = value
    return row


@pytest.mark.parametrize(
    ("forward", "lateral", "free", "action"),
    [(1, 0, 0, TOGGLE), (3, 0, 1, FORWARD), (2, 1, 1, FORWARD), (1, 2, 0, RIGHT), (1, -1, 0, LEFT), (0, 2, 1, RIGHT)],
)
def test_the_way_to_a_thing(forward: int, lateral: int, free: int, action: int) -> None:
    seen = features(closed_door_visible=1, closed_door_forward=forward, closed_door_lateral=lateral, free_ahead=free)
    assert approach(seen, "closed_door", TOGGLE).tolist() == [action]


def test_hand_made_options_solve_a_small_task_by_themselves() -> None:
    venv = agents.venv_of("MiniGrid-MultiRoom-N2-S4-v0", 0, hand_made=True)
    assert isinstance(venv.envs[0], OptionsWrapper)  # type: ignore[attr-defined]  # a DummyVecEnv
    assert agents.success_rate(agents.uniform(0), venv, 0) > 0.5  # primitives alone: 0.02


def curve(*points: tuple[int, float], **more: Any) -> dict[str, Any]:
    return {"curve": [list(point) for point in points], "option_runs": {}, "seconds": 1.0, **more}


def test_frames_count_those_of_all_stages() -> None:
    stages = FAMILIES["MultiRoom-4"]
    run = {"stages": [curve((100, 1.0)), curve((100, 0.4), (200, 0.85), (300, 0.7))]}
    assert frames_to(run, "MultiRoom-4", "discovered", 0.8) == stages[0].frames + 200
    assert frames_to(run, "MultiRoom-4", "discovered", 0.9) is None
    assert frames_to({"stages": [curve((200, 0.85))]}, "MultiRoom-4", "stock", 0.8) == 200


def test_shares_of_runs_that_reach_are_of_all_seeds_together() -> None:
    def seed(slot: int, source: Counter[str], target: Counter[str]) -> dict[str, Any]:
        stages = [curve(option_runs={str(slot): dict(source)}), curve(option_runs={str(slot): dict(target)})]
        success = {"sampled": 1.0, "greedy": 1.0, "uniform": 0.5}
        return {"stages": stages, "success": success, "options": [{"slot": slot, "where": "key at 1"}]}

    runs = [
        seed(0, Counter(subgoal=9, left_initiation=1), Counter(subgoal=1)),
        seed(1, Counter(subgoal=10), Counter(truncated=3)),
    ]
    summary = summarise("MultiRoom-4", {"discovered": runs})
    assert summary["options"] == {"key at 1": {"n_runs": 2, "reached": [0.95, 0.25], "runs": [20, 4]}}
