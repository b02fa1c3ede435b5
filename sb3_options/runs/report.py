"""Reports of a run: the tables at the end of training, and the options of a file."""

import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.discovery.settings import described
from sb3_options.options import file as option_file
from sb3_options.options.archive import NAME
from sb3_options.options.option import SubgoalOption
from sb3_options.options.policies import TabularPolicy
from sb3_options.runs import folder as runs
from sb3_options.runs.commands import InspectConfig
from sb3_options.runs.compare import Goal, compared, read_run, source_of, table_of
from sb3_options.runs.config import CLONING, TrainConfig, flag, importing, program

HEADINGS = ("slot", "option", "subgoal", "found after primitive steps", "initiation states", "policy", "longest run")


class Trained(NamedTuple):
    """The result of one training; ``signal`` is the number of an interrupt. Without a step, the folder is gone."""

    config: TrainConfig
    folder: Path
    discovery: SubgoalDiscoveryCallback
    finished: bool
    signal: int | None


def option_rows(file: option_file.OptionsFile, found: Mapping[int, int] | None = None) -> list[list[str]]:
    """Return a row of `HEADINGS` per option; ``found`` has the primitive steps of discovery by slot, if known."""
    features = file.made_for.features if file.made_for else None
    options: dict[int, SubgoalOption | str] = {**file.hand_made, **file.options()}
    rows = []
    for slot, option in sorted(options.items()):
        when = "" if found is None else f"{found[slot]:,}" if slot in found else "given at the start"
        if isinstance(option, str):
            rows.append([str(slot), option, "by hand: code, not in the file", when, "", "", ""])
            continue
        policy = option.option_policy
        kind = f"table of {len(policy.states):,} states" if isinstance(policy, TabularPolicy) else "network"
        points = option.subgoal.points
        subgoal = described(points[0], features, option.subgoal.group) if len(points) else "none"
        states = f"{len(option.initiation_set.points):,}"
        longest = f"{option.max_duration:,} steps"
        rows.append([str(slot), option.name, subgoal, when, states, f"{kind} on the {option.policy_input}", longest])
    return rows


def show_options(config: InspectConfig, console: Console) -> None:
    """Print the contents of a run folder, an options file or a ``model.zip``; nothing is unpickled."""
    file = option_file.opened(config.file / NAME if config.file.is_dir() else config.file)
    rows = option_rows(file)
    console.print(_table(HEADINGS, rows))
    slots = f"{len(rows)} of {file.max_options} slots are taken"
    console.print(f"{slots}; policies choose among {file.n_primitive} primitive actions.")
    space = file.made_for.space if file.made_for else None
    console.print(f"Made for observations {escape(space or 'of an unknown space')}.")
    console.print(f"SHA-256 {file.digest}")


def closing_report(console: Console, trained: Trained, *, draws: bool) -> None:
    """Print the options found, the results of training, and the next commands."""
    config, folder, discovery, finished, _ = trained
    unit = "episodes" if config.discovery.segmentation == "episodes" else "segments"
    steps = f"{discovery.num_timesteps:,} primitive steps, {discovery.episodes:,} {unit}"
    console.print(f"\n[bold]{'Finished' if finished else 'Interrupted'}[/] after {steps}.")
    rows = option_rows(option_file.opened(folder / NAME), {each.slot: each.timestep for each in discovery.discoveries})
    if rows:
        console.print("Options:", _table(HEADINGS, rows), sep="\n")
    elif discovery.max_new_options == 0:  # else the callback has said why
        console.print(escape(str(discovery.why_nothing())))
    try:
        run = read_run(folder)
        source = source_of([run])
        goal = Goal("success", 0.9) if "success" in run.curves[source] else None
        console.print(table_of(compared({"this run": [run]}, goal, source)))
    except ValueError as error:  # nothing was logged
        console.print(escape(str(error)))
    path = shlex.quote(str(folder))
    cloned = config.demonstrations and config.clone and config.algo in CLONING
    how = " --stochastic" if cloned else ""  # without memory a greedy policy may turn back and forth for ever
    video = f" --video {shlex.quote(f'{folder}/video.mp4')}" if draws else ""
    lines = [
        f"Run folder:   {folder}",
        f"TensorBoard:  python -m tensorboard.main --logdir {path}",
        f"Evaluate:     {program()} evaluate {path}{how}{video}{_importing(config)}",
    ]
    if not finished and (resume := how_to_resume(config, folder)):
        lines.append(resume)
    console.print(*map(escape, lines), sep="\n")


def _table(headings: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    table = Table(*headings)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def how_to_resume(config: TrainConfig, folder: Path) -> str:
    """Return the command that resumes from a run's last checkpoint; empty without one."""
    if not any(CheckpointFolder(folder / runs.CHECKPOINTS)):
        return ""
    path = shlex.quote(min(str(folder), os.path.relpath(folder), key=len))
    return f"Resume:       {program()} resume {path}{_importing(config)}"


def _importing(config: TrainConfig) -> str:
    """Return the flags that import a module. They must be passed again: a run's file is not trusted with them."""
    return "".join(f" {flag(n)} {shlex.quote(t)}" for n, t in importing(vars(config)).items())
