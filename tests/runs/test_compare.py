"""Runs are compared by what they logged: groups, steps until a goal, a table and a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_options.runs import compare
from sb3_options.runs.commands import CompareConfig

STEPS = [1000, 2000, 3000, 4000]


def logged(
    folder: Path, success: Sequence[float], settings: dict[str, Any] | None = None, source: str = "rollout"
) -> Path:
    """A run folder as SB3 writes it, with a success rate and a return every 1,000 steps."""
    writer = TensorBoardOutputFormat(str(folder / "tensorboard_1"))
    mean_return = {"rollout": "rollout/ep_rew_mean", "eval": "eval/mean_reward"}[source]
    for step, value in zip(STEPS, success, strict=False):
        values = {f"{source}/success_rate": value, mean_return: 2 * value}
        writer.write(values, dict.fromkeys(values, ()), step)
    writer.close()
    if settings is not None:
        (folder / "config.yml").write_text(yaml.safe_dump(settings))
    return folder


def run_of(*logs: Any, **more: Any) -> compare.Run:
    """The run that `logged` writes."""
    return compare.read_run(logged(*logs, **more))


def shown(table: Any) -> str:
    console = Console(width=120, no_color=True)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def test_a_run_is_read_whole(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", [0.0, 0.5, 0.75, 1.0], {"algo": "ppo"})
    curve = run.curves["rollout"]["success"]
    assert curve.steps.tolist() == STEPS
    assert curve.values.tolist() == [0.0, 0.5, 0.75, 1.0]
    assert run.curves["rollout"]["return"].values.tolist() == [0.0, 1.0, 1.5, 2.0]
    assert run.curves["eval"] == {}
    assert run.settings == {"algo": "ppo"}


def test_files_of_a_resumed_run_make_one_curve(tmp_path: Path) -> None:
    logged(tmp_path / "run", [0.0, 0.25])
    writer = TensorBoardOutputFormat(str(tmp_path / "run" / "tensorboard_1"))
    writer.write({"rollout/success_rate": 0.5}, {"rollout/success_rate": ()}, 3000)
    writer.close()
    assert compare.read_run(tmp_path / "run").curves["rollout"]["success"].values.tolist() == [0.0, 0.25, 0.5]


def test_a_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    logged(tmp_path / "empty", [])
    for folder in (tmp_path / "none", tmp_path / "empty"):
        with pytest.raises(ValueError, match="has no TensorBoard file with an evaluation"):
            compare.read_run(folder)


def test_runs_that_differ_in_their_seed_alone_are_a_group(tmp_path: Path) -> None:
    def run(name: str, **settings: Any) -> compare.Run:
        return run_of(tmp_path / "ppo" / name, [0.0, 1.0], {"algo": "ppo", **settings})

    runs = [
        run("a_1", seed=0, bonus="rnd", discovery={"decay": 0.9}),
        run("a_2", seed=1, bonus="rnd", discovery={"decay": 0.9}),
        run("a_3", seed=0, bonus="none", discovery={"decay": 0.9}),
        run("a_4", seed=0, bonus="rnd", discovery={"decay": 0.5}),
    ]
    groups = compare.grouped(runs)
    assert {name: [r.folder.name for r in members] for name, members in groups.items()} == {
        "bonus rnd, discovery.decay 0.9": ["a_1", "a_2"],
        "bonus none, discovery.decay 0.9": ["a_3"],
        "bonus rnd, discovery.decay 0.5": ["a_4"],
    }
    assert list(compare.grouped(runs[:2])) == ["ppo/a"]
    other = run_of(tmp_path / "dqn", [1.0], {"algo": "dqn", "n_envs": 1, "algo_kwargs": {"batch_size": 64}})
    own = "what an algorithm has of its own goes with it"
    assert list(compare.grouped([run("b_1"), other])) == ["algo ppo", "algo dqn"], own
    mine = run("b_2", algo_kwargs={"batch_size": 8})
    assert list(compare.grouped([run("b_1"), mine, other]))[1] == "algo ppo, algo_kwargs.batch_size 8"
    far = [run(f"c_{seed}", seed=seed, env_kwargs={"goal": [20, 0], "max_steps": 100}, gamma=0.5) for seed in (1, 2)]
    sizes = {name: len(members) for name, members in compare.grouped([*runs[:2], *far]).items()}
    assert sizes == {"ppo/a_1": 2, "ppo/c_1": 2}


def test_runs_of_others_are_grouped_by_their_folders(tmp_path: Path) -> None:
    runs = [run_of(tmp_path / algo / f"CartPole-v1_{n}", [1.0]) for algo in ("ppo", "dqn") for n in (1, 2)]
    sizes = {name: len(members) for name, members in compare.grouped(runs).items()}
    assert sizes == {"ppo/CartPole-v1": 2, "dqn/CartPole-v1": 2}


def folders(groups: dict[str, list[compare.Run]]) -> dict[str, list[Path]]:
    return {name: [run.folder for run in runs] for name, runs in groups.items()}


def test_groups_by_hand(tmp_path: Path) -> None:
    one, two, other = (logged(tmp_path / name, [0.0]) for name in ("a_1", "a_2", "b=1"))
    groups = compare.groups_of([f"ours={tmp_path}/a_*", str(other)])
    assert folders(groups) == {f"{tmp_path.name}/b=1": [other], "ours": [one, two]}
    with pytest.raises(ValueError, match="has no TensorBoard file"):
        compare.groups_of([f"{tmp_path}/c_*"])


def test_a_folder_of_runs_stands_for_them(tmp_path: Path) -> None:
    runs = [logged(tmp_path / "ppo" / f"a_{n}", [0.0, 1.0], {"algo": "ppo", "seed": n}) for n in range(2)]
    assert folders(compare.groups_of([f"ours={tmp_path / 'ppo'}"])) == {"ours": runs}
    assert folders(compare.groups_of([str(tmp_path)])) == {"ppo/a": runs}
    assert folders(compare.groups_of([str(runs[0])])) == {"ppo/a": runs[:1]}


def test_logs_of_others_in_a_folder_are_runs_of_their_own(tmp_path: Path) -> None:
    one, two = logged(tmp_path / "PPO_1", [0.0]), logged(tmp_path / "PPO_2", [0.0])
    assert folders(compare.groups_of([f"x={tmp_path}"])) == {"x": [one / "tensorboard_1", two / "tensorboard_1"]}
    assert folders(compare.groups_of([f"x={one}"])) == {"x": [one]}, "with one log it is a run itself"


@pytest.mark.parametrize("text", ["0.9", "success", "speed=1", "success=nan", "success=2", "success=0"])
def test_a_goal_that_says_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="--reach"):
        compare.Goal.parsed(text)
    assert compare.Goal.parsed("success=1") == compare.Goal("success", 1.0)
    assert compare.Goal.parsed("return=2") == compare.Goal("return", 2.0)


def test_a_goal_must_be_kept_for_two_entries() -> None:
    def curve(*values: float) -> compare.Curve:
        return compare.Curve(np.arange(1.0 * len(values)), np.array(values, dtype=np.float32).astype(np.float64))

    assert compare.Goal("success", 0.9).reached(curve(0.0, 1.0, 0.5, 0.9, 0.95)) == 3
    assert compare.Goal("success", 0.9).reached(curve(0.0, 0.5, 0.9)) is None
    assert compare.Goal("length", 40).reached(curve(90, 40, 39, 50)) == 1


def test_numbers_by_hand(tmp_path: Path) -> None:
    quick = [run_of(tmp_path / f"q_{i}", [0.0, 0.9, 0.9, 1.0]) for i in range(3)]
    slow = [run_of(tmp_path / f"s_{i}", [0.0, 0.0, 0.0, 1.0]) for i in range(2)]
    slow.append(run_of(tmp_path / "short", [0.0, 0.5, 0.5]))
    numbers = compare.compared({"quick": quick, "slow": slow}, compare.Goal("success", 0.9), "rollout")
    steps, never, sooner = "primitive steps to success rate ≥ 0.9", "runs that never get there", "Pr(sooner than quick)"
    assert numbers["quick"][steps] == (2000, 2000, 2000)
    assert numbers["slow"][steps] == (3000, 3000, 3000), "the shortest run is the budget of all"
    assert (numbers["quick"][never], numbers["slow"][never]) == (0, 3)
    assert (numbers["quick"][sooner], numbers["slow"][sooner]) == ("", (0.0, 0.0, 0.0))
    assert numbers["quick"]["success rate, at the end"] == pytest.approx((0.9, 0.9, 0.9))
    assert numbers["slow"]["return, at the end"][0] == pytest.approx(np.mean([0.0, 0.0, 1.0]), abs=1e-6)  # type: ignore[index]
    text = shown(compare.table_of(numbers))
    assert "2,000 (2,000 to 2,000)" in text
    assert sooner in text


def test_one_run_says_nothing_of_others(tmp_path: Path) -> None:
    groups = {n: [run_of(tmp_path / n, s)] for n, s in {"a": [0.0, 0.9, 0.9], "b": [0.9, 0.9, 0.9]}.items()}
    numbers = compare.compared(groups, compare.Goal("success", 0.9), "rollout")
    assert numbers["b"]["Pr(sooner than a)"] == (1.0, 0.0, 1.0)


def test_evaluations_count_where_all_have_them(tmp_path: Path) -> None:
    evaluated = run_of(tmp_path / "a", [1.0, 1.0], source="eval")
    trained = run_of(tmp_path / "b", [1.0, 1.0])
    assert compare.source_of([evaluated]) == "eval"
    assert compare.source_of([trained, evaluated]) == "rollout"
    with pytest.raises(ValueError, match="did not log rollout/success_rate: leave it out"):
        compare.show_comparison(CompareConfig((str(evaluated.folder), str(trained.folder))), Console())


def test_a_picture_has_a_row_for_each_measure(tmp_path: Path) -> None:
    groups = {n: [run_of(tmp_path / f"{n}_{i}", [0.0, 0.5, 1.0]) for i in range(2)] for n in ("a", "b")}
    figure = compare.figure_of(groups, "rollout")
    assert [axes.get_ylabel() for axes in figure.axes] == ["success rate", "return"]
    assert [len(axes.lines) for axes in figure.axes] == [2, 2]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a (2)", "b (2)"]
    figure.savefig(tmp_path / "compare.png")


@pytest.mark.parametrize(("name", "n"), [("a", 7), ("bonus rnd, discovery.decay 0.9", 3), ("x" * 60, 2)])
def test_the_names_of_all_groups_are_within_the_picture(name: str, n: int, tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", [0.0, 0.5, 1.0])
    figure = compare.figure_of({f"{name}{number}": [run] for number in range(n)}, "rollout")
    figure.savefig(tmp_path / "compare.png")
    names = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= names.x0 < names.x1 <= figure.bbox.x1
