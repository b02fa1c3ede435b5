"""The command line: train a run, resume it, evaluate it, compare runs, show options."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import torch
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.atomic import atomic_write
from sb3_options.callbacks import CheckpointCallback, IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.callbacks.checkpoints import EndedAtCheckpointError, load_checkpoint
from sb3_options.checkpoints.environments import refusal
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.execution.workers import WorkerLostError, end_workers
from sb3_options.experience.success import success_rule
from sb3_options.extras import how_to_install
from sb3_options.options.bank import OptionBank
from sb3_options.runs import config as configs
from sb3_options.runs import evaluation
from sb3_options.runs import folder as runs
from sb3_options.runs.algorithms import callback_settings, check_algorithm, check_device, make_model, warn_without_gpu
from sb3_options.runs.budget import KeepToBudget, memory_is_short, rounded_up
from sb3_options.runs.card import write_card
from sb3_options.runs.closing import Trained, how_to_resume, program_name, report, unit_of
from sb3_options.runs.compare import CompareConfig, show_comparison
from sb3_options.runs.config import TrainConfig
from sb3_options.runs.eval_callback import eval_callback_class
from sb3_options.runs.flags import parse
from sb3_options.runs.hparams import hparams_of
from sb3_options.runs.inspection import InspectConfig, show_options
from sb3_options.runs.interrupts import PATIENCE, Interrupts, StopWhenNoted
from sb3_options.runs.keywords import NUMBERS
from sb3_options.runs.resume import ResumeConfig, lengthen, mark_finished, resume_run
from sb3_options.runs.tune_config import TuneConfig
from sb3_options.runs.under_way import held
from sb3_options.runs.video import mode_among

console = Console(highlight=False, soft_wrap=True)
errors = Console(highlight=False, soft_wrap=True, stderr=True)

TRY_AGAIN = 75
"""Exit status where a worker process was killed: ``EX_TEMPFAIL`` of sysexits.h."""


def main(args: Sequence[str] | None = None) -> None:
    """Run a command line: a command and its arguments, or an algorithm and the flags of its settings.

    Args:
        args: Without the program's name; by default those of the process.
    """
    args = sys.argv[1:] if args is None else list(args)
    command, prog, interrupts = (args or [""])[0], program_name(), Interrupts()
    try:
        if command in COMMANDS:
            of, run = COMMANDS[command]
            run = partial(resume, interrupts=interrupts) if run is resume else run
            run(tyro.cli(of, prog=f"{prog} {command}", args=args[1:], registry=NUMBERS))
        else:
            train(parse(args[1:] if command == "train" else args, prog), interrupts)
    except KeyboardInterrupt as interrupt:
        errors.print(" ".join(["Interrupted", *interrupt.args]) + ".")
        sys.exit(interrupts.status)
    except WorkerLostError as error:
        _stop(error, error.what, TRY_AGAIN if error.killed else 1)
    except (ValueError, TypeError, OSError, ModuleNotFoundError, gym.error.Error) as error:
        _stop(error, str(error))
    except (MemoryError, RuntimeError) as error:
        if (text := memory_is_short(error)) is None:
            raise
        _stop(error, text)
    if interrupts.noted:
        sys.exit(interrupts.status)


def _stop(error: BaseException, text: str, status: int = 1) -> NoReturn:
    """Exit with one line."""
    errors.print(f"[bold red]Error:[/] {escape(' '.join([text, *getattr(error, '__notes__', ())]).strip())}")
    sys.exit(status)


def train(config: TrainConfig, interrupts: Interrupts | None = None) -> Path:
    """Train, and leave a run folder.

    An interrupt or an error ends training early; what was learned until then is kept. Before the first step there is
    nothing to keep, and no folder is left.

    Args:
        config: Of the run.
        interrupts: Notes them; by default one of its own.

    Returns:
        The run folder.

    Raises:
        KeyboardInterrupt: An interrupt came before the first step.
        ValueError: Something in the configuration does not fit.
        OSError: The run folder cannot be written.
        WorkerLostError: A worker process of ``--vec-env subproc`` has ended.
    """
    return _train(config, interrupts=interrupts).folder


def resume(resumed: ResumeConfig, interrupts: Interrupts | None = None) -> None:
    """Go on with a run that was cut off; see `resume_run`.

    Raises:
        As `train`, and as `resume_run`.
    """
    resume_run(resumed, partial(_train, interrupts=interrupts), console)


def _train(
    config: TrainConfig,
    *,
    resumed: Path | None = None,
    interrupts: Interrupts | None = None,
) -> Trained:
    torch.set_num_threads(config.num_threads)
    runs.check_env_id(config.env)
    check_device(config.device)
    warn_without_gpu(config.device)
    check_algorithm(config)
    without_discovery: Trained | None = None
    with interrupts or Interrupts() as interrupts:
        with closing(runs.make_env(config, 1, config.seed)) as env:  # what cannot be made leaves no folder
            runs.check_observations(env, config.env)
            draws = mode_among(env.get_attr("metadata")[0]) is not None
            bank: OptionBank = env.get_attr("bank")[0]
            started_with = [f"{slot} ({option.name})" for slot, option in enumerate(bank.slots) if option is not None]
        discovery = _discovery(config, resumed)
        trained = _train_once(config, discovery, interrupts, resumed=resumed)
        if config.compare and config.discover and resumed is None and not interrupts.noted:
            console.print("Once more, without discovery:")
            other = dataclasses.replace(config, discover=False, compare=False, options=None)
            without_discovery = _train_once(other, _discovery(other), interrupts)
    if not trained.folder.exists():
        raise KeyboardInterrupt("before the first step: there is nothing to keep")
    took = f"{discovery.num_timesteps:,} primitive steps, {discovery.episodes:,} {unit_of(config)}s"
    console.print(f"\n[bold]{'Finished' if trained.finished else 'Interrupted'}[/] after {took}.")
    if config.options is not None:
        what = ", ".join(started_with) or "none"
        console.print(f"Started with the options of {escape(str(config.options))}: {escape(what)}.")
    _show_discoveries(config, discovery)
    report(console, trained, without_discovery, draws=draws)
    return trained


def _train_once(
    config: TrainConfig,
    discovery: SubgoalDiscoveryCallback,
    interrupts: Interrupts,
    *,
    resumed: Path | None = None,
) -> Trained:
    """Train, and leave all of a run folder; none without a step taken, unless it was there before."""
    folder = runs.new_run_folder(config) if resumed is None else resumed
    with nullcontext() if resumed else held(folder):  # who resumes holds it already
        finished = _learn(config, discovery, folder, interrupts, resume=resumed is not None)
        if folder.exists():
            _draw(config, discovery, folder)
            write_card(folder, config, discovery.history, {d.slot: d.timestep for d in discovery.discoveries})
        if finished:
            mark_finished(config, folder)  # last: who was killed before does the end again
    return Trained(config, folder, discovery, finished, interrupts.noted)


def _discovery(config: TrainConfig, resumed: Path | None = None) -> SubgoalDiscoveryCallback:
    options = config.options if resumed is None else runs.options_of(resumed)
    return SubgoalDiscoveryCallback(
        config.discovery,
        config.option,
        max_new_options=config.max_new_options if config.discover else 0,
        success=config.success,
        usefulness=config.usefulness,
        hparams=hparams_of(config, options),
        seed=config.seed,
        verbose=1,
        **callback_settings(config),
    )


def _learn(
    config: TrainConfig,
    discovery: SubgoalDiscoveryCallback,
    folder: Path,
    interrupts: Interrupts,
    *,
    resume: bool = False,
) -> bool:
    """Train, and save what was learned, however training ends; without a step taken, remove a new folder.

    Returns:
        Whether training came to its end.
    """
    interrupts.saving, interrupts.patience = False, 0.0
    discovery.save_path = folder / runs.OPTIONS
    model: BaseAlgorithm | None = None
    envs: list[VecEnv] = []
    finished = False
    try:
        monitors = folder / runs.MONITOR
        envs.append(runs.make_env(config, config.n_envs, config.seed, monitor_dir=monitors, vec_env=config.vec_env))
        if not resume:
            configs.save(config, folder / runs.CONFIG)
        model = make_model(config, envs[0])
        model.tensorboard_log = str(folder)
        callbacks: list[BaseCallback] = [discovery]
        if config.bonus != "none":
            callbacks.append(IntrinsicRewardCallback(config.bonus, seed=config.seed))
        if config.eval_freq > 0:
            limit = config.eval_max_steps
            seed = evaluation.EVAL_SEED + config.seed
            envs.append(runs.make_env(config, 1, seed, vec_env=config.vec_env, max_steps=limit))
            how = {"n_eval_episodes": config.eval_episodes, "eval_freq": 1, "verbose": 0}
            # What is success of a segment is none of an episode.
            rule = success_rule(config.success) if config.discovery.segmentation == "episodes" else None
            evaluation_callback = eval_callback_class(config.algo)(interrupts, folder, rule, envs[1], **how)
            # EvalCallback counts calls of step, of which one may be many primitive steps.
            callbacks.append(EveryNTimesteps(config.eval_freq, evaluation_callback))
        callbacks += [KeepToBudget(), StopWhenNoted(interrupts)]
        if config.checkpoint_freq > 0:
            callbacks += _checkpoints(config, folder, model, callbacks, interrupts, resume=resume)
        interrupts.ended = interrupts.noted
        if not interrupts.noted:
            what = f"{config.algo.upper()} on {config.env} for {config.n_timesteps:,} primitive steps"
            console.print(f"Training {escape(what)}.")
            if not resume and (text := rounded_up(config)):
                console.print(escape(text))
            if not resume and config.compare and config.discover:
                console.print("Afterwards once more without discovery; --no-compare leaves that out.")
            # A model that was not trained yet counts from 0 all the same, but goes on in the same TensorBoard folder.
            log: dict[str, Any] = {"tb_log_name": "tensorboard", "reset_num_timesteps": not resume}
            model.learn(config.n_timesteps, callbacks, progress_bar=config.progress, **log)
        finished = not interrupts.ended
    except EndedAtCheckpointError:
        interrupts.ended = True
    except KeyboardInterrupt:
        interrupts.noted = interrupts.ended = True
    except Exception as error:
        # An interrupt that was sent to the worker processes, too, has ended them.
        if not (interrupts.noted and isinstance(error, WorkerLostError | EOFError | ConnectionError)):
            if model is not None and model.num_timesteps > 0:
                error.add_note(f"What was learned until then is kept in {folder}.")
            if isinstance(error, WorkerLostError) and (resume or (model is not None and model.num_timesteps > 0)):
                error.add_note(how_to_resume(config, folder))
            raise
        interrupts.ended = True
    finally:
        interrupts.saving = True  # before anything else: from now on no interrupt is raised
        try:
            if model is None or model.num_timesteps == 0:
                if not resume:
                    runs.discard(folder)
            else:
                runs.save(model, discovery.bank, folder)
        except OSError as error:
            error.add_note(how_to_resume(config, folder))
            raise
        finally:
            for env in envs:
                if finished:
                    with suppress(WorkerLostError):  # it was not needed any more
                        env.close()
                else:
                    end_workers(env)  # which may be in the middle of a step
    return finished


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
        lengthen(folder, config.n_timesteps)
    return [checkpoints]


def _show_discoveries(config: TrainConfig, discovery: SubgoalDiscoveryCallback) -> None:
    if discovery.discoveries:
        table = Table("option", "subgoal", f"found after {unit_of(config)}", "primitive steps", "initiation states")
        for found in discovery.discoveries:
            table.add_row(
                str(found.slot),
                found.where,
                str(found.episode),
                f"{found.timestep:,}",
                str(found.initiation_states),
            )
        console.print("Subgoals discovered:")
        console.print(table)
    elif discovery.max_new_options == 0:  # else the callback has said why
        console.print(discovery.why_nothing())


def _draw(config: TrainConfig, discovery: SubgoalDiscoveryCallback, folder: Path) -> None:
    assert discovery.discovery is not None  # training has started
    bank = discovery.bank
    if config.vec_env != "dummy":  # φ was in a process that has ended
        env = runs.make_env(config, 1, config.seed)
        bank.bind(lambda observations: env.env_method("concept_features", observations)[0])
    with atomic_write(folder / runs.SUBGOALS) as temporary:
        figure = subgoals_figure(discovery.discovery, bank, discovery.why_nothing())
        figure.savefig(temporary, dpi=110)


def tune(config: TuneConfig) -> None:
    """Search for settings.

    Raises:
        ModuleNotFoundError: Optuna is not installed.
        Otherwise as `sb3_options.runs.tune.tune`.
    """
    try:
        from sb3_options.runs import tune as tuning  # Optuna is in an extra
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}. Searching takes Optuna: {how_to_install('tune')}.") from error
    tuning.tune(config, console=console)


evaluate = partial(evaluation.show_evaluation, console=console)

COMMANDS: dict[str, tuple[type[Any], Callable[[Any], object]]] = {
    "evaluate": (evaluation.EvaluateConfig, evaluate),
    "resume": (ResumeConfig, resume),
    "compare": (CompareConfig, partial(show_comparison, console=console)),
    "tune": (TuneConfig, tune),
    "options": (InspectConfig, partial(show_options, console=console)),
}
"""What a command takes, and what it does."""
