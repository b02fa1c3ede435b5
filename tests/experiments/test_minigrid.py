import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.minigrid import agents, ratios, settings, tune
from experiments.minigrid.__main__ import Study, main
from experiments.minigrid.hand_made import options_on
from experiments.minigrid.ratios import ratio_of_medians
from experiments.minigrid.settings import FAMILIES, Arm, Stage
from experiments.minigrid.summary import frames_to
from sb3_options import OptionsWrapper

EACH_KIND: tuple[Arm, ...] = (
    "discovered, RND at first", "discovered with φ, RND before the last", "proposed groups, RND at first",
    "random subgoals", "contrasting subgoals", "hand-made", "hand-made subgoals, 3 cells", "stock, curriculum",
    "stock, RND", "stock with φ", "stock, rl-zoo3's settings", "stock",
)  # fmt: skip


@pytest.fixture
def small_family(monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stage("MiniGrid-Empty-5x5-v0", 128), Stage("MiniGrid-MultiRoom-N2-S4-v0", 128)
    monkeypatch.setitem(FAMILIES, "small", stages)
    for name in ("N_ENVS", "ZOO_N_ENVS", "EPISODES"):
        monkeypatch.setattr(settings, name, 2)
    for of, name, value in ((settings.PPO, "batch_size", 64), (settings.ZOO, "n_epochs", 1)):
        monkeypatch.setitem(of, "n_steps", 64)
        monkeypatch.setitem(of, name, value)


@pytest.mark.usefixtures("small_family")
def test_study_writes_results_and_picture(tmp_path: Path) -> None:
    main(Study(out=tmp_path, runs=1, first_seed=0, jobs=1, family="small", arms=EACH_KIND))
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written["summary"]["arms"]) == set(EACH_KIND)
    assert set(written["summary"]["uniform"]) == set(EACH_KIND) & set(settings.WITH_OPTIONS)
    assert {arm: len(runs[0]["stages"]) for arm, runs in written["runs"].items()} == {
        arm: 1 if arm == "stock" else 2 for arm in EACH_KIND
    }
    assert set(written["special"]) == set(EACH_KIND) - {"stock, curriculum", "stock"}
    assert (tmp_path / "minigrid.png").stat().st_size > 5_000


@pytest.mark.usefixtures("small_family")
def test_settings_are_tuned_for_each_agent_and_used_by_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tune, "SPACE", {name: tune.SPACE[name] for name in ("learning_rate", "clip_range")})
    arms: tuple[Arm, ...] = ("stock, E3B", "discovered, RND at first")
    tune.main(tune.Tuning(out=tmp_path, family="small", arms=arms, trials=2, first_seed=3, seeds=1, jobs=1))
    tuned = json.loads((tmp_path / "tuned.json").read_text())["tuned"]
    assert set(tuned) == set(arms)
    assert all(set(of["settings"]) == {"learning_rate", "clip_range", "weight"} for of in tuned.values())
    runs = sorted((tmp_path / "stock_E3B").glob("*/seeds/3.json"))
    tried = [json.loads(path.read_text())["settings"] for path in runs]
    assert tried[0] == {"learning_rate": 1e-3, "clip_range": 0.2, "weight": 0.1}
    assert len(tried) == 2

    arm = arms[0]
    out = tmp_path / "study"
    study = Study(out=out, runs=1, first_seed=3, jobs=1, family="small", arms=(arm,), judged=(), until=tune.REACHED)
    main(dataclasses.replace(study, learned=tune.LEARNED, tuned=tmp_path / "tuned.json"))
    written = json.loads((out / "results.json").read_text())
    assert written["special"][arm]["tuned"] == tuned[arm]["settings"]
    best = json.loads(runs[tuned[arm]["trial"]].read_text())["result"]
    assert written["runs"][arm][0]["stages"][-1]["curve"] == best["stages"][-1]["curve"]


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("family", FAMILIES)
def test_a_model_can_go_through_all_stages(family: str) -> None:
    venvs = [agents.venv_of(stage.env_id, 0, n_envs=1) for stage in FAMILIES[family]]
    assert len({str((venv.observation_space, venv.action_space)) for venv in venvs}) == 1


def test_hand_made_options_solve_a_small_task_by_themselves() -> None:
    venv = agents.venv_of("MiniGrid-MultiRoom-N2-S4-v0", 0, slots=4, by_hand=options_on)
    assert isinstance(venv.envs[0], OptionsWrapper)  # type: ignore[attr-defined]  # a DummyVecEnv
    assert agents.success_rate(agents.uniform(0), venv, 0) > 0.5  # primitives alone: 0.02


def test_an_agent_with_features_sees_what_discovery_sees() -> None:
    venvs = [agents.venv_of("MiniGrid-DoorKey-5x5-v0", 0, slots=1, with_features=seen) for seen in (False, True)]
    plain, seen = (venv.reset() for venv in venvs)
    assert isinstance(plain, np.ndarray)
    assert isinstance(seen, np.ndarray)
    features = [
        venv.env_method("concept_features", of, indices=[0])[0] for venv, of in zip(venvs, (plain, seen), strict=True)
    ]
    assert np.array_equal(seen, np.hstack([plain, features[0]]))
    assert np.array_equal(*features)
    groups = [venv.get_attr("features", indices=[0])[0].groups for venv in venvs]
    assert groups[0] == groups[1]
    assert len(groups[0]) > 5


def curve(*points: tuple[int, float], **more: Any) -> dict[str, Any]:
    taken = {"option_runs": {}, "seconds": 1.0, "processor_seconds": 0.5}
    return {"curve": [list(point) for point in points], **taken, **more}


def test_frames_count_those_of_all_stages() -> None:
    stages = FAMILIES["MultiRoom-4"]
    run = {"stages": [curve((100, 1.0)), curve((100, 0.9), (200, 0.4), (300, 0.85), (400, 0.8))]}
    assert frames_to(run, "MultiRoom-4", "discovered", 0.8) == stages[0].frames + 300  # where it stays
    assert frames_to(run, "MultiRoom-4", "discovered", 0.9) is None
    assert frames_to({"stages": [curve((200, 0.85))]}, "MultiRoom-4", "stock", 0.8) == 200


def test_the_tables_of_the_page_are_those_of_the_results(tmp_path: Path) -> None:
    document = Path("docs/studies/minigrid.md")
    copy = tmp_path / "minigrid.md"
    copy.write_text(document.read_text(encoding="utf-8"), encoding="utf-8")
    ratios.main(ratios.Ratios(document=copy, picture=tmp_path / "minigrid.png"))
    assert copy.read_text(encoding="utf-8") == document.read_text(encoding="utf-8")
    assert (tmp_path / "minigrid.png").stat().st_size > 5_000


def test_ratios_of_medians() -> None:
    ratio, low, high = ratio_of_medians([1.0, 2.0, 3.0], [4.0] * 3)
    assert ratio == 0.5
    assert 0.25 <= low < 0.5 < high <= 0.75
    assert ratio_of_medians([1.0] * 3, [2.0] * 3) == (0.5, 0.5, 0.5)
    assert ratio_of_medians([1.0] * 3, [np.inf] * 3) == (0.0, 0.0, 0.0), "the rival never gets there"
    assert ratio_of_medians([1.0, 1.0, np.inf], [2.0] * 3)[2] == np.inf, "nor do some of these"
