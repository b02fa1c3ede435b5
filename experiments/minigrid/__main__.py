"""Options that travel: discovered in a small task of MiniGrid, used in a large one, against PPO with the same frames.

``python -m experiments.minigrid --runs 8 --out FOLDER`` writes ``results.json`` and ``minigrid.png``. Interrupted, it
goes on where it was. Needs the extra ``minigrid``.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import tyro
from rich.table import Table

from experiments.common.documents import number
from experiments.common.seeds import Part, run_parts
from experiments.common.study import Flags, show, write
from experiments.minigrid import settings
from experiments.minigrid.conditions import JUDGED, Judged, Protocol, run
from experiments.minigrid.plots import draw
from experiments.minigrid.settings import ARMS, FAMILIES, Arm
from experiments.minigrid.summary import Summary, summarise


@dataclass(frozen=True, kw_only=True)
class Study(Flags):
    """Train agents through the stages of a family of tasks for many seeds.

    Attributes:
        family: Which.
        arms: Which agents.
        learned: A stage before the last ends when this share of the last episodes succeeded; by default, when its
            frames are used up.
        until: Likewise the last stage, once every environment has had time for the longest episode.
        judged: Policies that play fresh episodes in the end: as sampled, the likeliest actions, or a uniform choice.
        tuned: File that ``experiments.minigrid.tune`` wrote, with settings for each agent.
    """

    runs: int = 8
    family: str = "MultiRoom-4"
    arms: tuple[Arm, ...] = ARMS
    learned: float | None = None
    until: float | None = None
    judged: tuple[Judged, ...] = JUDGED
    tuned: Path | None = None


def main(study: Study) -> None:
    """Run the study, and write and print what it found."""
    if study.family not in FAMILIES:
        raise SystemExit(f"--family must be one of {', '.join(FAMILIES)}, got {study.family}.")
    for name in ("learned", "until"):
        share = getattr(study, name)
        if share is not None and not 0 < share <= 1:
            raise SystemExit(f"--{name} must be a share of episodes in (0, 1], got {share:g}.")
    protocol = Protocol(study.learned, study.until, study.judged)
    out = study.out / study.family
    special = {arm: settings.of(arm, study.family) for arm in study.arms}
    if study.tuned is not None:
        tuned = json.loads(study.tuned.read_text(encoding="utf-8"))
        if tuned["family"] != study.family or not tuned["tuned"].keys() >= special.keys():
            raise SystemExit(f"--tuned: {study.tuned} has no settings for these agents in {study.family}.")
        for arm, of in special.items():
            of["tuned"] = tuned["tuned"][arm]["settings"]
    parts = [
        Part(arm, partial(run, study.family, arm, protocol, tuned=of.get("tuned")), out / folder_of(arm), of)
        for arm, of in special.items()
    ]
    used = {
        "stages": FAMILIES[study.family],
        **asdict(protocol),
        "ppo": settings.PPO,
        "n_envs": settings.N_ENVS,
        "max_options": settings.max_options(study.family),
        "episodes": settings.EPISODES,
    }
    results = run_parts(parts, study.seeds(), settings=used, on=study, description="Training")
    summary = summarise(study.family, results)
    command = f"python -m experiments.minigrid --family {study.family} --runs {study.runs} "
    command += "" if study.learned is None else f"--learned {study.learned:g} "
    command += "" if study.until is None else f"--until {study.until:g} "
    command += "" if study.judged == JUDGED else f"--judged {' '.join(study.judged)} "
    command += "" if study.tuned is None else f"--tuned {study.tuned} "
    command += f"--first-seed {study.first_seed} --arms {' '.join(map(repr, study.arms))}"
    content = {"command": command, **used, "special": {arm: of for arm, of in special.items() if of}}
    content |= {"summary": summary, "runs": results}
    write(study.out, content, {"minigrid": draw(study.family, results)}, dpi=110)
    show(_table(summary), f"Results: {study.out / 'results.json'}, {study.out / 'minigrid.png'}")


def folder_of(arm: Arm) -> str:
    """The name of an arm as that of a folder."""
    return arm.replace(", ", "_").replace(" ", "-").replace("'", "")


def _table(summary: Summary) -> Table:
    table = Table("agent", "seeds", *(f"success, {how}" for how in ("sampled", "greedy")), "frames to 0.8", "seconds")
    for arm, row in summary["arms"].items():
        success = [number(row["success"][how]) if how in row["success"] else "" for how in ("sampled", "greedy")]
        frames = [str(at) if at is not None else "never" for at in row["frames_to"]["0.8"]]
        table.add_row(arm, str(row["n_runs"]), *success, ", ".join(frames), number(row["seconds"], form="{:.0f}"))
    for arm, interval in summary["uniform"].items():
        table.add_row(f"uniform choice among options ({arm}) and primitives", "", number(interval))
    return table


if __name__ == "__main__":
    main(tyro.cli(Study))
