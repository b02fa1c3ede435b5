"""Training a run, and going on with one that was cut off."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.atomic import atomic_write
from sb3_options.callbacks import CheckpointCallback, IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.callbacks.checkpoints import EndedAtCheckpointError, load_checkpoint
from sb3_options.checkpoints.environments import refusal
from sb3_options.checkpoints.file import CheckpointFolder
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.execution.workers import WorkerLostError, end_workers
from sb3_options.experience.success import success_rule
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import check_device, class_of, make_model
from sb3_options.runs.budget import KeepToBudget, rounded_up
from sb3_options.runs.commands import EVAL_SEED, ResumeConfig
from sb3_options.runs.config import HOW_IT_RAN, TrainConfig
from sb3_options.runs.eval_callback import eval_callback_class
from sb3_options.runs.interrupts import PATIENCE, Interrupts, StopWhenNoted
from sb3_options.runs.report import Trained, closing_report, how_to_resume, write_card
from sb3_options.runs.under_way import held
from sb3_options.runs.users_code import IMPORTING
from sb3_options.runs.video import mode_among

FINISHED = f"{runs.CHECKPOINTS}/finished.yml"
"""File in a run folder whose training has come to its end."""

console = Console(highlight=False, soft_wrap=True)


def train(config: TrainConfig, interrupts: Interrupts | None = None, *, resumed: Path | None = None) -> Trained:
    """Train, and leave a run folder.

    An interrupt or an error ends training early, and what was learned is kept. Before the first step nothing is kept,
    and no folder is left.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)  # small networks are fastest with one
    runs.check_env_id(config.env)
    check_device(config.device)
    class_of(config.algo)  # an algorithm that is not installed leaves no folder
    other: Trained | None = None
    with interrupts or Interrupts() as interrupts:
        with closing(runs.make_env(config, 1, config.seed)) as env:  # an error leaves no folder
            get_obs_shape(env.observation_space)  # refuses what SB3 cannot learn from
            draws = mode_among(env.get_attr("metadata")[0]) is not None
        trained = _train_once(config, interrupts, resumed)
        if config.compare and config.discover and resumed is None and not interrupts.noted:
            console.print("Once more, without discovery:")
            without = dataclasses.replace(config, discover=False, compare=False, options=None)
            other = _train_once(without, interrupts)
    if not trained.folder.exists():
        raise KeyboardInterrupt("before the first step: there is nothing to keep")
    closing_report(console, trained, other, draws=draws)
    return trained


def discovery_callback(config: TrainConfig, *, verbose: int = 0) -> SubgoalDiscoveryCallback:
    """The callback that a run trains with."""
    return SubgoalDiscoveryCallback(
        config.discovery,
        config.option,
        max_new_options=config.max_new_options if config.discover else 0,
        success=config.success,
        usefulness=config.usefulness,
        seed=config.seed,
        verbose=verbose,
    )


def resume(resumed: ResumeConfig, interrupts: Interrupts | None = None) -> None:
    """Go on with a run. A finished run is left as it is."""
    run = resumed.run
    if not (run / runs.CONFIG).is_file():
        raise FileNotFoundError(f"{run} is no run folder: there is no {runs.CONFIG} in it.")
    with held(run):
        config = config_of(resumed)
        if is_finished(config, run):
            console.print(f"{escape(str(run))} is finished: it has trained for {config.n_timesteps:,} primitive steps.")
            console.print("To train on, pass --n-timesteps with a larger number.")
        else:
            train(config, interrupts, resumed=run)


def config_of(resumed: ResumeConfig) -> TrainConfig:
    """The configuration of a run as it goes on. The options it started with are in the checkpoint."""
    _refuse_links(resumed.run)
    if not any(CheckpointFolder(resumed.run / runs.CHECKPOINTS)):
        raise FileNotFoundError(
            f"There is no checkpoint in {resumed.run} to go on from: it was cut off before its first one, or trained "
            "with --checkpoint-freq 0."
        )
    config = configs.load(resumed.run / runs.CONFIG, {name: getattr(resumed, name) for name in IMPORTING})
    total = resumed.n_timesteps or config.n_timesteps
    if total < config.n_timesteps:
        raise ValueError(f"--n-timesteps must be at least {config.n_timesteps:,}, as {resumed.run} has it.")
    return dataclasses.replace(config, n_timesteps=total, options=None, progress=resumed.progress)


def _refuse_links(run: Path) -> None:
    """Keep what training writes and removes inside the run folder, which a stranger may have made."""
    for path in run.rglob("*"):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ValueError(
                f"{path} is a link, or neither a file nor a folder. Training would write to what it leads to. Put a "
                "copy in its place to go on with this run."
            )


def is_finished(config: TrainConfig, run: Path) -> bool:
    """Whether a run has trained for as long as its configuration says."""
    if not ((run / FINISHED).is_file() and (run / runs.MODEL).is_file()):
        return False
    trained = yaml_file.read_mapping(run / FINISHED).get("n_timesteps")
    return isinstance(trained, int) and trained >= config.n_timesteps


def _mark_finished(config: TrainConfig, run: Path) -> None:
    if (run / FINISHED).parent.is_dir():
        with atomic_write(run / FINISHED) as temporary:
            temporary.write_text(f"n_timesteps: {config.n_timesteps}\n", encoding="utf-8")


def _lengthen(run: Path, n_timesteps: int) -> None:
    """Have the configuration of a run say that it trains for longer, for the next `resume`."""
    content = yaml_file.read_mapping(run / runs.CONFIG)
    if content.get("n_timesteps") != n_timesteps:
        with atomic_write(run / runs.CONFIG) as temporary:
            text = yaml_file.dump(content | {"n_timesteps": n_timesteps}, sort_keys=False)
            temporary.write_text(text, encoding="utf-8")


def _train_once(config: TrainConfig, interrupts: Interrupts, resumed: Path | None = None) -> Trained:
    """Train, and leave all of a run folder; none without a step taken, unless it was there before."""
    options = config.options if resumed is None else runs.options_of(resumed)
    discovery = discovery_callback(config, verbose=1)
    discovery.hparams = _hparams_of(config, options)
    folder = runs.new_run_folder(config) if resumed is None else resumed
    with nullcontext() if resumed else held(folder):  # `resume` holds it already
        finished = _learn(config, discovery, folder, interrupts, resume=resumed is not None)
        trained = Trained(config, folder, discovery, finished, interrupts.noted)
        if folder.exists():
            _draw(config, discovery, folder)
            write_card(trained)
        if finished:
            _mark_finished(config, folder)  # last: a process that was killed before does the end again
    return trained


def _hparams_of(config: TrainConfig, options: Path | None) -> dict[str, object]:
    """The settings for TensorBoard's HParams tab; of ``options`` the last two parts, because run folders are moved."""
    values = configs.as_values(config) | {"options": None if options is None else "/".join(options.parts[-2:])}
    return {name: value for name, value in values.items() if name not in HOW_IT_RAN}


def _learn(
    config: TrainConfig, discovery: SubgoalDiscoveryCallback, folder: Path, interrupts: Interrupts, *, resume: bool
) -> bool:
    """Train, and save the result however training ends; remove a new folder if no step was taken."""
    interrupts.saving = False
    interrupts.patience = 0.0
    discovery.save_path = folder / runs.OPTIONS
    model: BaseAlgorithm | None = None
    envs: list[VecEnv] = []
    finished = False
    try:
        monitors = folder / runs.MONITOR
        envs.append(runs.make_env(config, config.n_envs, config.seed, monitor_dir=monitors, vec_env=config.vec_env))
        model = make_model(config, envs[0])
        if not resume:
            configs.save(config, folder / runs.CONFIG)
        model.tensorboard_log = str(folder)
        callbacks = [discovery, *_bonus(config), *_evaluation(config, folder, envs, interrupts)]
        callbacks += [KeepToBudget(), StopWhenNoted(interrupts)]
        if config.checkpoint_freq > 0:
            callbacks += _checkpoints(config, folder, model, callbacks, interrupts, resume=resume)
        interrupts.ended = interrupts.noted
        if not interrupts.noted:
            _say_what_begins(config, resume=resume)
            # A model that was not trained yet counts from 0 all the same, but goes on in the same TensorBoard folder.
            model.learn(
                config.n_timesteps,
                callbacks,
                progress_bar=config.progress,
                tb_log_name="tensorboard",
                reset_num_timesteps=not resume,
            )
        finished = not interrupts.ended
    except EndedAtCheckpointError:
        interrupts.ended = True
    except KeyboardInterrupt:
        interrupts.noted = True
        interrupts.ended = True
    except Exception as error:
        # An interrupt that was sent to the worker processes, too, has ended them.
        if not (interrupts.noted and isinstance(error, WorkerLostError | EOFError | ConnectionError)):
            trained = model is not None and model.num_timesteps > 0
            if trained:
                error.add_note(f"What was learned until then is kept in {folder}.")
            if isinstance(error, WorkerLostError) and (resume or trained):
                error.add_note(how_to_resume(config, folder))
            raise
        interrupts.ended = True
    finally:
        interrupts.saving = True  # before anything else: from now on no interrupt is raised
        with _closed(envs, finished=finished):
            _save(config, model, discovery, folder, resume=resume)
    return finished


def _say_what_begins(config: TrainConfig, *, resume: bool) -> None:
    steps = f"{config.n_timesteps:,} primitive steps"
    console.print(f"Training {config.algo.upper()} on {escape(config.env)} for {steps}.")
    if resume:
        return
    if text := rounded_up(config):
        console.print(escape(text))
    if config.compare and config.discover:
        console.print("Afterwards once more without discovery; --no-compare leaves that out.")


def _bonus(config: TrainConfig) -> list[BaseCallback]:
    return [] if config.bonus == "none" else [IntrinsicRewardCallback(config.bonus, seed=config.seed)]


def _evaluation(config: TrainConfig, folder: Path, envs: list[VecEnv], interrupts: Interrupts) -> list[BaseCallback]:
    """The callback of ``--eval-freq``; its environment is added to ``envs``."""
    if config.eval_freq == 0:
        return []
    seed = EVAL_SEED + config.seed
    env = runs.make_env(config, 1, seed, vec_env=config.vec_env, max_steps=config.eval_max_steps)
    envs.append(env)
    # A rule for segments says nothing of episodes.
    rule = success_rule(config.success) if config.discovery.segmentation == "episodes" else None
    episodes = config.eval_episodes
    callback = eval_callback_class(config.algo)(
        interrupts, folder, rule, env, n_eval_episodes=episodes, eval_freq=1, verbose=0
    )
    # EvalCallback counts calls of step, of which one may be many primitive steps.
    return [EveryNTimesteps(config.eval_freq, callback)]


def _checkpoints(
    config: TrainConfig,
    folder: Path,
    model: BaseAlgorithm,
    callbacks: list[BaseCallback],
    interrupts: Interrupts,
    *,
    resume: bool,
) -> list[BaseCallback]:
    """The callback that writes them, if the environment allows it; training goes on from the last one to ``resume``."""
    why = refusal(model.get_env())
    if why is not None and not resume:
        console.print(f"[yellow]No checkpoints:[/] {escape(why)}")
        return []
    interrupts.patience = PATIENCE
    where = folder / runs.CHECKPOINTS
    checkpoints = CheckpointCallback(where, config.checkpoint_freq, end_when=lambda: interrupts.noted)
    if resume:
        steps = load_checkpoint(where, model, [*callbacks, checkpoints])
        anew = "" if steps else " There is no later checkpoint."
        console.print(f"Going on after {steps:,} primitive steps.{anew}")
        _lengthen(folder, config.n_timesteps)
    return [checkpoints]


def _save(
    config: TrainConfig,
    model: BaseAlgorithm | None,
    discovery: SubgoalDiscoveryCallback,
    folder: Path,
    *,
    resume: bool,
) -> None:
    try:
        if model is not None and model.num_timesteps > 0:
            runs.save(model, discovery.bank, folder)
        elif not resume:
            runs.discard(folder)
    except OSError as error:
        error.add_note(how_to_resume(config, folder))
        raise


@contextmanager
def _closed(envs: list[VecEnv], *, finished: bool) -> Iterator[None]:
    """Close environments afterwards; workers of an unfinished training are ended, perhaps in the middle of a step."""
    try:
        yield
    finally:
        for env in envs:
            if finished:
                with suppress(WorkerLostError):  # it is not needed any more
                    env.close()
            else:
                end_workers(env)


def _draw(config: TrainConfig, discovery: SubgoalDiscoveryCallback, folder: Path) -> None:
    assert discovery.discovery is not None  # training has started
    bank = discovery.bank
    if config.vec_env != "dummy":  # φ was in a process that has ended
        env = runs.make_env(config, 1, config.seed)
        bank.bind(lambda observations: env.env_method("concept_features", observations)[0])
    with atomic_write(folder / runs.SUBGOALS) as temporary:
        subgoals_figure(discovery.discovery, bank, discovery.why_nothing()).savefig(temporary, dpi=110)
