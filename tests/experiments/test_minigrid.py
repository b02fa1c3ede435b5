import importlib.util
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from experiments.minigrid import agents, conditions, settings, summary
from experiments.minigrid.__main__ import Study, main
from experiments.minigrid.conditions import stages_of
from experiments.minigrid.hand_made import options_on
from experiments.minigrid.ratios import AGENTS, Ratios, draw, fresh_table, ratio_of_medians, reach_table, table
from experiments.minigrid.settings import ARMS, FAMILIES, Arm, Stage
from experiments.minigrid.summary import frames_to, median_frames, summarise
from sb3_options import OptionsWrapper
from sb3_options.callbacks import IntrinsicRewardCallback


def test_study_writes_results_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stage("MiniGrid-Empty-5x5-v0", 600), Stage("MiniGrid-MultiRoom-N2-S4-v0", 600)
    monkeypatch.setitem(FAMILIES, "small", stages)
    monkeypatch.setattr(settings, "N_ENVS", 2)
    monkeypatch.setattr(settings, "EPISODES", 2)
    monkeypatch.setitem(settings.PPO, "n_steps", 64)
    monkeypatch.setitem(settings.PPO, "batch_size", 64)
    monkeypatch.setattr(settings, "ZOO_N_ENVS", 2)
    monkeypatch.setitem(settings.ZOO, "n_steps", 64)
    monkeypatch.setitem(settings.ZOO, "n_epochs", 1)
    main(Study(out=tmp_path, runs=1, first_seed=0, jobs=1, family="small"))
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written["summary"]["arms"]) == set(ARMS)
    assert set(written["summary"]["uniform"]) == set(settings.WITH_OPTIONS)
    assert {arm: len(runs[0]["stages"]) for arm, runs in written["runs"].items()} == {
        arm: 1 if arm == "stock" else 2 for arm in ARMS
    }
    assert set(written["special"]) == set(ARMS) - {"stock, curriculum", "stock"}
    assert (tmp_path / "minigrid.png").stat().st_size > 5_000


def test_all_agents_get_the_same_frames() -> None:
    for family in FAMILIES:
        frames = {arm: sum(stage.frames for stage in stages_of(family, arm)) for arm in ARMS}
        assert len(set(frames.values())) == 1
        assert {stages_of(family, arm)[-1].env_id for arm in ARMS} == {FAMILIES[family][-1].env_id}


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("family", FAMILIES)
def test_a_model_can_go_through_all_stages(family: str) -> None:
    venvs = [agents.venv_of(stage.env_id, 0, n_envs=1) for stage in FAMILIES[family]]
    assert len({str((venv.observation_space, venv.action_space)) for venv in venvs}) == 1


def test_hand_made_options_solve_a_small_task_by_themselves() -> None:
    venv = agents.venv_of("MiniGrid-MultiRoom-N2-S4-v0", 0, slots=4, by_hand=options_on)
    assert isinstance(venv.envs[0], OptionsWrapper)  # type: ignore[attr-defined]  # a DummyVecEnv
    assert agents.success_rate(agents.uniform(0), venv, 0) > 0.5  # primitives alone: 0.02


def test_the_last_environments_rehearse_and_say_nothing_of_success() -> None:
    venv = agents.venv_of("MiniGrid-Empty-5x5-v0", 0, rehearsed=("MiniGrid-Empty-6x6-v0", 2), n_envs=3)
    assert [env.width for env in venv.get_attr("unwrapped")] == [5, 6, 6]
    notes = agents.Notes(1, learned=0.0)
    notes.locals = {"infos": [{}, {"is_success": True}, {"is_success": False}]}
    assert notes._on_step()
    assert not notes._successes
    notes.locals["infos"][0] = {"is_success": True}
    assert notes._on_step()
    assert list(notes._successes) == [True]


@pytest.mark.parametrize("family", FAMILIES)
def test_settings_of_rl_zoo3_are_those_that_it_has(family: str) -> None:
    """Those of the last task, or, where it has none, of one that is alike."""
    found = importlib.util.find_spec("rl_zoo3")  # to import it would change environments of this process
    assert found is not None
    assert found.origin is not None
    written = yaml.safe_load((Path(found.origin).parent / "hyperparams/ppo.yml").read_text())
    theirs = written.get(FAMILIES[family][-1].env_id, written["MiniGrid-MultiRoom-N4-S5-v0"])
    of = settings.of(settings.ZOO_ARM, family)
    assert of["ppo"] == {name: theirs[name] for name in settings.ZOO}
    assert (of["n_envs"], of["normalised"]) == (theirs["n_envs"], theirs["normalize"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"runs": 0}, "--runs must be at least 1, got 0"),
        ({"learned": 2.0}, "--learned must be a share of episodes"),
        ({"until": 0.0}, "--until must be a share of episodes"),
        ({"family": "Doors"}, "--family must be one of MultiRoom-4, "),
    ],
)
def test_flags_that_say_nothing_are_refused(given: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=re.escape(message)):
        main(Study(out=tmp_path, **given))


def test_each_agents_option_is_judged_where_it_was_found_and_in_the_last_task() -> None:
    def ends(arrived: int, n: int) -> dict[str, int]:
        return {"subgoal": arrived, "left_initiation": n - arrived}

    first = {"reach A": ends(16, 20), "reach B": ends(15, 20)}
    last = {"reach A": ends(13, 20), "reach B": ends(700, 1000), "reach C": ends(0, 19)}
    options = [{"where": "A", "stage": 0}, {"where": "B", "stage": 0}, {"where": "C", "stage": 1}]
    run = {"options": options, "stages": [{"option_runs": first}, {"option_runs": last}]}
    assert summary.reach([run, run]) == {
        "source": {"options": 4, "below": 2},  # B twice; C has too few runs
        "target": {"options": 4, "below": 2},  # A twice
    }


def curve(*points: tuple[int, float], **more: Any) -> dict[str, Any]:
    return {
        "curve": [list(point) for point in points],
        "option_runs": {},
        "seconds": 1.0,
        "processor_seconds": 0.5,
        **more,
    }


def test_frames_count_those_of_all_stages() -> None:
    stages = FAMILIES["MultiRoom-4"]
    run = {"stages": [curve((100, 1.0)), curve((100, 0.9), (200, 0.4), (300, 0.85), (400, 0.8))]}
    assert frames_to(run, "MultiRoom-4", "discovered", 0.8) == stages[0].frames + 300  # where it stays
    assert frames_to(run, "MultiRoom-4", "discovered", 0.9) is None
    assert frames_to({"stages": [curve((200, 0.85))]}, "MultiRoom-4", "stock", 0.8) == 200


@pytest.mark.parametrize(
    ("frames", "median"),
    [([3, 1, 2], 2), ([4, None, 1, 2], 3), ([1, None, 2, None], None), ([None, 1, None], None), ([None, 2, 1], 2)],
)
def test_who_never_gets_there_is_the_slowest(frames: list[int | None], median: float | None) -> None:
    assert median_frames(frames) == median


def test_the_bonus_ends_before_the_last_task() -> None:
    def has_bonus(arm: Arm, stage: int, *, is_last: bool) -> bool:
        callbacks = conditions._callbacks(arm, 0, stage, is_last=is_last, primitive_rollouts=True)
        return any(isinstance(callback, IntrinsicRewardCallback) for callback in callbacks)

    for who in ("discovered", "stock"):
        at_first, before_last, always = (
            [has_bonus(arm, stage, is_last=stage == 2) for stage in range(3)]  # type: ignore[arg-type]  # f-strings
            for arm in (f"{who}, RND at first", f"{who}, RND before the last", f"{who}, RND")
        )
        assert (at_first, before_last, always) == ([True, False, False], [True, True, False], [True] * 3)


def test_shares_of_runs_that_reach_are_of_all_seeds_together() -> None:
    def seed(source: Counter[str], target: Counter[str]) -> dict[str, Any]:
        stages = [
            curve(option_runs={"reach key at 1": dict(ends), "other": {"subgoal": 5}}) for ends in (source, target)
        ]
        success = {"sampled": 1.0, "greedy": 1.0, "uniform": 0.5}
        found = {"where": "key at 1", "stage": 0}  # twice: the first was closed
        return {"stages": stages, "success": success, "options": [found, found]}

    runs = [
        seed(Counter(subgoal=9, left_initiation=1), Counter(subgoal=1)),
        seed(Counter(subgoal=10), Counter(truncated=3)),
    ]
    summary = summarise("MultiRoom-4", {"discovered": runs})
    assert summary["options"] == {"key at 1": {"n_runs": 2, "reached": [0.95, 0.25], "runs": [20, 4]}}


def test_ratios_of_medians() -> None:
    ratio, low, high = ratio_of_medians([1.0, 2.0, 3.0], [4.0] * 3)
    assert ratio == 0.5
    assert 0.25 <= low < 0.5 < high <= 0.75
    assert ratio_of_medians([1.0] * 3, [2.0] * 3) == (0.5, 0.5, 0.5)
    assert ratio_of_medians([1.0] * 3, [np.inf] * 3) == (0.0, 0.0, 0.0), "the rival never gets there"
    assert ratio_of_medians([1.0, 1.0, np.inf], [2.0] * 3)[2] == np.inf, "nor do some of these"


def test_the_page_has_the_ratios_of_the_committed_results() -> None:
    page = Path("docs/studies/minigrid.md").read_text()
    for name, made in {"ratios": table, "fresh": fresh_table, "reach": reach_table}.items():
        assert page.split(f"<!-- {name} -->")[1].split(f"<!-- end {name} -->")[0].strip() == made(Path("docs/results"))


def test_the_picture_has_a_panel_for_each_task() -> None:
    figure = draw(Ratios().results)
    assert [axes.get_title() for axes in figure.axes] == list(AGENTS)
    for axes, rows in zip(figure.axes, AGENTS.values(), strict=True):
        assert [label.get_text() for label in axes.get_yticklabels()] == list(rows)
        assert all(1e3 < x <= 1e7 for line in axes.lines for x in np.asarray(line.get_xdata(), dtype=float))
