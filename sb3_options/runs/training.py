"""Trains a run, or resumes an interrupted one."""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from contextlib import ExitStack, closing, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.vec_env import VecEnv

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options.atomic import atomic_write
from sb3_options.callbacks import CheckpointCallback, IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.callbacks.checkpoints import EndedAtCheckpointError, load_checkpoint
from sb3_options.checkpoints.environments import refusal
from sb3_options.discovery.figures import subgoals_figure
from sb3_options.execution.workers import WorkerLostError, end_workers
from sb3_options.experience.success import SuccessRule, judged, success_rule, tell_success
from sb3_options.runs import config as configs
from sb3_options.runs import folder as runs
from sb3_options.runs import yaml_file
from sb3_options.runs.algorithms import class_of, make_model
from sb3_options.runs.commands import EVAL_SEED, ResumeConfig
from sb3_options.runs.config import HOW_IT_RAN, TrainConfig
from sb3_options.runs.report import Trained, closing_report, how_to_resume
from sb3_options.runs.video import mode_among

FINISHED = f"{runs.CHECKPOINTS}/finished.yml"  # file that marks a run folder whose training is complete

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

PATIENCE = 5.0  # seconds for training to reach a point where it can write a checkpoint: Docker kills 10 s after SIGTERM
EVAL_STEPS = 1_000  # maximum primitive steps of an evaluation episode, if the environment id has no limit


class Interrupts:
    """Handles `SIGNALS` while its ``with`` block runs.

    Python raises `KeyboardInterrupt` anywhere in the program, and some code loses it. SB3's ``DummyVecEnv.step``
    deep-copies an ``OrderedDict``, where ``copyreg`` takes any exception for a missing attribute. So the first signal
    is only noted, and a second one raises. No signal raises during saving. SIGINT is handled even if it was ignored, as
    in background processes of a script. SIGHUP is left to ``nohup``.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self.saving = False
        self.patience = 0.0
        self._at = 0.0

    def __enter__(self) -> Interrupts:
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def was_sent(self) -> bool:
        """Whether training is to end once it can write a checkpoint."""
        return self.signal is not None

    def due(self) -> bool:
        """Whether training is to end now, wherever it is."""
        return self.signal is not None and time.monotonic() >= self._at + self.patience

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.saving:
            return
        if self.signal is not None:
            raise KeyboardInterrupt
        self._at = time.monotonic()
        self.signal = number
        with suppress(OSError):  # no print: the signal may interrupt one, and the terminal may be gone
            os.write(2, b"\nInterrupted: training ends soon and is saved. Once more to end it at once.\n")


class _RuledEvalCallback(EvalCallback):
    """Logs success by the run's rule; None means the environment's own."""

    remembers_nothing = True  # between evaluations, beyond EvalCallback's own memory
    rule: SuccessRule | None = None

    def _init_callback(self) -> None:
        super()._init_callback()
        self.eval_env.env_method("set_slots", record=True)

    def _on_step(self) -> bool:
        self._unreported: list[bool] = []
        return super()._on_step()

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        info = locals_["info"]
        with suppress(ValueError):  # the environment reports no Boolean; training says so
            if self.rule is not None and "trajectory" in info:
                trajectory = info.pop("trajectory")
                logged = self._is_success_buffer
                said = judged(self.rule, trajectory)
                in_training = bool(self.model.ep_success_buffer)
                tell_success(info, said, trajectory, self.rule, logged, self._unreported, reported=in_training)
                self._unreported.append(said)
        super()._log_success_callback(locals_, globals_)


def use_one_thread() -> None:
    """Let torch compute in one thread, unless the environment says otherwise.

    Small networks are fastest so. Beside other work, threads that wait for each other take several times as long.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)


def train(config: TrainConfig, console: Console | None = None, *, resumed: Path | None = None) -> Trained:
    """Train in a new run folder, or resume a run.

    After an interrupt or an error, the result so far is kept. Before the first step nothing is kept, not even the
    folder.
    """
    console = console or Console(highlight=False, soft_wrap=True)
    use_one_thread()
    class_of(config.algo)  # a missing algorithm leaves no folder
    with Interrupts() as interrupts:
        discovery = discovery_callback(config, verbose=1)
        with closing(runs.make_env(config, 1, config.seed)) as env:  # an error leaves no folder
            get_obs_shape(env.observation_space)  # refuses observations that SB3 does not support
            draws = mode_among(env.get_attr("metadata")[0]) is not None
        folder = resumed or runs.new_run_folder(config)
        discovery.save_path = folder / runs.OPTIONS
        discovery.hparams = {n: v for n, v in configs.as_values(config).items() if n not in (*HOW_IT_RAN, "options")}
        with nullcontext() if resumed else runs.held(folder):  # `resume` holds it already
            finished = _learn(config, discovery, folder, interrupts, console, resume=resumed is not None)
            if not folder.exists():
                raise KeyboardInterrupt("before the first step: there is nothing to keep.")
            _draw(config, discovery, folder)
            if finished and (folder / runs.CHECKPOINTS).is_dir():
                # Last: a process killed before this point repeats the end.
                yaml_file.write(folder / FINISHED, {"n_timesteps": config.n_timesteps})
    trained = Trained(config, folder, discovery, finished, interrupts.signal)
    closing_report(console, trained, draws=draws)
    return trained


def discovery_callback(config: TrainConfig, *, verbose: int = 0) -> SubgoalDiscoveryCallback:
    """Make the discovery callback of a run."""
    return SubgoalDiscoveryCallback(
        config.discovery,
        config.option,
        max_new_options=config.max_new_options,
        success=config.success,
        usefulness=config.usefulness,
        demonstrations=config.demonstrations,
        clone=config.clone,
        verbose=verbose,
    )


def resume(resumed: ResumeConfig, console: Console) -> Trained | None:
    """Resume a run. A finished run stays unchanged."""
    run = resumed.run
    with runs.held(run):
        _refuse_links(run)
        config = configs.load(run / runs.CONFIG, resumed.trusted())
        total = max(resumed.n_timesteps or 0, config.n_timesteps)
        # The checkpoint holds the options that the run started with.
        config = dataclasses.replace(config, n_timesteps=total, options=None, progress=resumed.progress)
        if not is_finished(config, run):
            return train(config, console, resumed=run)
    console.print(f"{escape(str(run))} is finished: it has trained for {config.n_timesteps:,} primitive steps.")
    console.print("To train on, pass --n-timesteps with a larger number.")
    return None


def _refuse_links(run: Path) -> None:
    """Refuse links, so that training changes only the run folder, which a stranger may have made."""
    for path in run.rglob("*"):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ValueError(
                f"{path} is a link, or neither a file nor a folder. Training would write to what it leads to. Put a "
                "copy in its place to go on with this run."
            )


def is_finished(config: TrainConfig, run: Path) -> bool:
    """Whether a run has trained for its configured number of steps."""
    if not ((run / FINISHED).is_file() and (run / runs.MODEL).is_file()):
        return False
    trained = yaml_file.read_mapping(run / FINISHED).get("n_timesteps")
    return isinstance(trained, int) and trained >= config.n_timesteps


def _learn(
    config: TrainConfig,
    discovery: SubgoalDiscoveryCallback,
    folder: Path,
    interrupts: Interrupts,
    console: Console,
    *,
    resume: bool,
) -> bool:
    """Train, and save the result however training ends; remove a new folder if no step was taken."""
    model: BaseAlgorithm | None = None
    envs: list[VecEnv] = []
    finished = False
    try:
        monitors = folder / runs.MONITOR
        envs.append(runs.make_env(config, config.n_envs, config.seed, monitor_dir=monitors, vec_env=config.vec_env))
        model = make_model(config, envs[0])
        model.tensorboard_log = str(folder)
        if not resume:
            configs.save(config, folder / runs.CONFIG)
        callbacks: list[BaseCallback] = [discovery]
        if config.bonus != "none":
            callbacks.append(IntrinsicRewardCallback(config.bonus, seed=config.seed))
        if config.eval_freq > 0:
            callbacks.append(_evaluation(config, folder, envs))
        callbacks.append(ConvertCallback(lambda *_: not interrupts.due()))
        where = folder / runs.CHECKPOINTS
        why = refusal(envs[0]) if config.checkpoint_freq > 0 and not resume else None
        if why is not None:
            console.print(f"[yellow]No checkpoints:[/] {escape(why)}")
        elif config.checkpoint_freq > 0:
            interrupts.patience = PATIENCE
            callbacks.append(CheckpointCallback(where, config.checkpoint_freq, end_when=interrupts.was_sent))
        if resume:
            steps = load_checkpoint(where, model, callbacks)
            console.print(f"Going on after {steps:,} primitive steps.")
            content = yaml_file.read_mapping(folder / runs.CONFIG)
            # For the next `resume`.
            yaml_file.write(folder / runs.CONFIG, content | {"n_timesteps": config.n_timesteps})
        if interrupts.signal is None:
            console.print(
                f"Training {config.algo.upper()} on {escape(config.env)} for {config.n_timesteps:,} primitive steps."
            )
            # An untrained model counts from 0 in any case, but a resumed one continues in the same TensorBoard folder.
            model.learn(
                config.n_timesteps,
                callbacks,
                progress_bar=config.progress,
                tb_log_name="tensorboard",
                reset_num_timesteps=not resume,
            )
            finished = model.num_timesteps >= config.n_timesteps
    except EndedAtCheckpointError:
        pass
    except KeyboardInterrupt:
        interrupts.signal = interrupts.signal or signal.SIGINT
    except Exception as error:
        # An interrupt may also have reached the worker processes and ended them.
        if interrupts.signal is None or not isinstance(error, WorkerLostError | EOFError | ConnectionError):
            trained = model is not None and model.num_timesteps > 0
            if trained:
                error.add_note(f"What was learned until then is kept in {folder}.")
            if isinstance(error, WorkerLostError) and (resume or trained):
                error.add_note(how_to_resume(config, folder))
            raise
    finally:
        interrupts.saving = True  # first of all: from now on no interrupt is raised
        with ExitStack() as stack:
            stack.enter_context(suppress(WorkerLostError))  # the worker is no longer needed
            for env in envs:
                if finished:
                    stack.callback(env.close)
                else:
                    stack.callback(end_workers, env)  # perhaps in the middle of a step
            if model is not None and model.num_timesteps > 0:
                runs.save(model, discovery.bank, folder)
            elif not resume:
                runs.discard(folder)
    return finished


def _evaluation(config: TrainConfig, folder: Path, envs: list[VecEnv]) -> BaseCallback:
    """Make the callback of ``--eval-freq``, and add its environment to ``envs``."""
    env = runs.make_env(config, 1, EVAL_SEED + config.seed, vec_env=config.vec_env, max_steps=EVAL_STEPS)
    envs.append(env)
    of: type[_RuledEvalCallback] = _RuledEvalCallback
    if config.algo == "maskableppo":
        from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback

        of = type("MaskableEvalCallback", (_RuledEvalCallback, MaskableEvalCallback), {})
    callback = of(
        env,
        n_eval_episodes=config.eval_episodes,
        eval_freq=1,
        log_path=str(folder),
        best_model_save_path=str(folder),
        verbose=0,
    )
    if config.discovery.segmentation == "episodes":  # a rule for segments does not apply to episodes
        callback.rule = success_rule(config.success)
    # EvalCallback counts calls of step, each of which may be many primitive steps.
    return EveryNTimesteps(config.eval_freq, callback)


def _draw(config: TrainConfig, discovery: SubgoalDiscoveryCallback, folder: Path) -> None:
    assert discovery.discovery is not None  # training has started
    bank = discovery.bank
    if config.vec_env != "dummy":  # φ was in a process that has ended
        env = runs.make_env(config, 1, config.seed)
        bank.bind(lambda observations: env.env_method("concept_features", observations)[0])
    with atomic_write(folder / runs.SUBGOALS) as temporary:
        subgoals_figure(discovery.discovery, bank, discovery.why_nothing()).savefig(temporary, dpi=110)
