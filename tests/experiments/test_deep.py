"""The deep study, small: its arithmetic against numbers worked out by hand, and that it runs and resumes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.deep import __main__ as deep
from experiments.deep import arms, conditions, report, tasks, tune
from experiments.deep.settings import DeepSettings
from experiments.deep.summary import (
    curve,
    steps_to_success,
    summarise,
)
from sb3_options import OptionReplayBuffer
from sb3_options.envs import GridWorld

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def result(steps: list[int], success: list[float], length: float = 20.0, **kwargs: Any) -> dict[str, Any]:
    return {"steps": steps, "success": success, "final_length": length, "final_success": 1.0, "options": []} | kwargs


def test_steps_to_success() -> None:
    lucky_once = result([0, 1000, 2000, 3000, 4000], [0.0, 0.9, 0.5, 1.0, 0.9])
    assert steps_to_success(lucky_once, 9000) == 3000
    assert steps_to_success(result([0, 1000, 2000], [0.0, 0.85, 1.0]), 9000) == 9000


def test_a_curve_holds_its_last_value() -> None:
    np.testing.assert_array_equal(curve(result([0, 900, 1500], [0.0, 0.4, 1.0]), 2500), [0, 0, 0.4, 1, 1, 1])


def test_summary_by_hand() -> None:
    stock = [result([0, 2000, 3000], [0.0, 1.0, 1.0], 20.0) for _ in range(4)]
    ours = [result([0, 1000, 2000], [0.0, 1.0, 1.0], 22.0, brought=[[1.0, 2.0]]) for _ in range(3)]
    ours.append(result([0, 1000], [0.0, 0.2], 22.0))
    numbers = summarise({"stock": stock, "options": ours}, 4000)
    assert numbers["stock"]["steps_to_90"]["mean"] == 2000
    assert numbers["options"]["steps_to_90"]["mean"] == 1000  # the interquartile mean leaves the failure out
    assert numbers["options"]["mean_steps_to_90"]["mean"] == 1750
    assert numbers["options"]["never"] == 1
    assert numbers["options"]["with_option"] == 3
    assert numbers["options"]["steps_to_90_of_stock"]["mean"] == 0.5
    assert numbers["options"]["probability_of_improvement"]["mean"] == 0.75
    assert numbers["options"]["final_steps_of_stock"]["mean"] == pytest.approx(1.1)


def test_steps_of_the_best_policy_in_a_corridor() -> None:
    # From 3 cells away with certain moves; half as certain, every step is one of 4 directions half of the time.
    assert tasks.optimal_steps(GridWorld("S..G", success_probability=1.0)) == pytest.approx(3.0)
    lone = GridWorld("SG", success_probability=0.0)
    assert tasks.optimal_steps(lone) == pytest.approx(4.0)  # one direction of four


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"env": "ThreeRooms"}, "--env: there is no 'ThreeRooms' for --task same, choose from TwoRooms, KeyDoor"),
        ({"env": "KeyDoor", "task": "transfer"}, "no 'KeyDoor' for --task transfer, choose from TwoRooms, FourR"),
        ({"algo": "dqn,sac"}, "--algo: there is no 'sac'"),
        ({"arms": "stock,magic"}, "--arms: there is no 'magic'"),
        (
            {"algo": "ppo", "arms": "n-step"},
            "n-step returns need an algorithm with a replay buffer, for instance --alg",
        ),
    ],
)
def test_what_there_is_not_is_named(tmp_path: Path, arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(SystemExit, match=text):
        deep.Study(out=tmp_path, **arguments)


def test_report_fills_its_document(tmp_path: Path) -> None:
    numbers = summarise(
        {"stock": [result([0, 1000, 2000], [0.0, 1.0, 1.0])] * 4, "options": [result([0], [0.0])] * 4}, 3000
    )
    results, document = tmp_path / "results.json", tmp_path / "deep.md"
    command = "python -m experiments.deep --task same --env TwoRooms"
    results.write_text(json.dumps({"command": command, "results": {"TwoRooms": {"ppo": numbers}}}))
    marks = (f"<!-- {name} -->\n<!-- end {name} -->\n" for name in report.PARTS)
    document.write_text("".join(marks))
    control = tmp_path / "control.json"
    control.write_text(json.dumps({"command": f"{command} --settings.both-as options", "results": {}}))
    report.main(report.Report((results, control), document))
    text = document.read_text()
    assert f"<!-- same -->\n`{command}`" in text
    assert f"<!-- control -->\n`{command} --settings.both-as options`" in text
    assert "| PPO, TwoRooms: stock | 4 |  | 1,000 (1,000 to 1,000) |" in text
    assert "| PPO, TwoRooms: discovered options | 4 | 0 | 3,000 (3,000 to 3,000) | 3.00 (3.00 to 3.00) | 0.00" in text


def test_study_writes_results_and_picture_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = DeepSettings(evaluate_every=250, evaluation_episodes=2, final_evaluations=1)
    short = {key: tasks.Task(t.env, t.target, t.source, 500, 300) for key, t in tasks.TASKS.items()}
    monkeypatch.setattr(deep, "TASKS", short)
    study = deep.Study(out=tmp_path, task="transfer", env="FourRooms", runs=1, jobs=1, settings=settings)
    deep.main(study)
    content = json.loads((tmp_path / "results.json").read_text())
    for algo in ("dqn", "ppo"):
        for arm in ("stock", "options", "repeats"):
            assert content["results"]["FourRooms"][algo][arm]["n_runs"] == 1
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    kept = sorted(tmp_path.glob("runs/*/seeds/*.json"))
    assert len(kept) == 6
    assert (tmp_path / "seconds.png").stat().st_size > 10_000
    for run in content["runs"]["FourRooms"]["dqn"]["options"]:
        assert len(run["seconds"]) == len(run["steps"])
        assert run["seconds"] == sorted(run["seconds"])
        assert 0 <= run["seconds"][0] < run["seconds"][-1] < content["seconds"]
    before = [path.stat().st_mtime_ns for path in kept]
    deep.main(study)
    assert [path.stat().st_mtime_ns for path in kept] == before


@pytest.mark.parametrize("algo", ["dqn", "dqn-unmasked", "ppo"])
@pytest.mark.parametrize("arm", ["n-step", "count-bonus", "rnd", "options-n-step", "options-bonus"])
def test_arms_beside_the_three(algo: str, arm: Any) -> None:
    """Each learns from what its name says, which a single run of a few hundred steps can show."""
    if not arms.has_arm(algo, arm):
        return
    task = tasks.Task("sb3_options/TwoRooms-v0", n_timesteps=800)
    settings = DeepSettings(evaluate_every=400, evaluation_episodes=1, final_evaluations=1, bonus_weight=0.3)
    result, discovery, model = conditions.train(task, algo, arm, settings, 0)
    assert len(result["seconds"]) == len(result["steps"]) >= 2
    assert (discovery is None) == (not arm.startswith("options"))
    buffer: Any = getattr(model, "replay_buffer", None)
    if arm in arms.N_STEP:
        assert buffer.n_steps == settings.n_steps == 10
        assert settings.of(algo, arm)["n_steps"] == 10
    if arm in arms.BONUS:
        assert settings.of(algo, arm)["bonus_weight"] == 0.3
        assert "bonus_weight" not in settings.of(algo, "options")
    assert isinstance(buffer, OptionReplayBuffer) == (algo != "ppo" and discovery is not None)
    if buffer is None:  # rewards of the task are 0 but at the goal; those of a rollout with a bonus are not
        assert (model.rollout_buffer.rewards != 0).mean() > 0.9  # type: ignore[attr-defined]


def test_settings_of_options_are_those_that_tuning_chose() -> None:
    best = json.loads((RESULTS / "deep-tuning-ppo-options.json").read_text())["best"]
    settings = DeepSettings()
    used = dict(settings.ppo["options"])
    assert used.pop("policy_kwargs") == {"net_arch": tune.NET_ARCHS[best.pop("net_arch")]}
    assert settings.max_option_exploration["ppo"] == best.pop("max_option_exploration")
    del used["n_steps"], best["n_steps"]  # chosen by hand, with `max_runs`
    assert used == pytest.approx(best, rel=0.01)


def test_the_command_says_what_was_varied() -> None:
    assert DeepSettings().switched() == []
    varied = DeepSettings(
        both_as="stock",
        max_option_exploration={"dqn": 0.5, "ppo": 0.25},
        max_runs={"dqn": 7, "ppo": 0},
        callback={"interruption": False},
        n_steps=3,
    )
    assert varied.switched() == [
        "--settings.both-as stock",
        "--settings.n-steps 3",
        "--settings.max-option-exploration.ppo 0.25",
        "--settings.max-runs.dqn 7",
        "--settings.max-runs.ppo 0",
        "--settings.callback.no-interruption",
    ]
    assert varied.arguments("ppo", "options") == varied.ppo["stock"] != DeepSettings().arguments("ppo", "options")
    assert DeepSettings(both_as="options").arguments("ppo", "stock") == varied.ppo["options"]


@pytest.mark.parametrize("arm", ["stock", "options"])
def test_tuning_writes_what_was_best_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arm: Any) -> None:
    key = ("transfer", "FourRooms")
    task = tasks.TASKS[key]
    monkeypatch.setattr(tune, "TASKS", {key: tasks.Task(task.env, task.target, task.source, 300, 200)})
    tune.main(tune.Tuning(out=tmp_path, algo="ppo", arm=arm, trials=1, seeds=1, jobs=1))
    tune.main(tune.Tuning(out=tmp_path, algo="ppo", arm=arm, trials=2, seeds=1, jobs=1))
    written = json.loads((tmp_path / f"ppo-{arm}" / "tuned.json").read_text())
    assert written["finished"] + written["pruned"] == 2
    assert written["steps_to_90"] == {"transfer, FourRooms": [300]}
    assert set(written["best"]) >= {"learning_rate", "n_steps", "net_arch"}
