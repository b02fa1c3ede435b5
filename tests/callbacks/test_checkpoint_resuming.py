"""Killed and resumed is never interrupted: every array of the final state is equal, byte for byte."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from experiments.kills.states import differing
from sb3_options import OptionReplayBuffer
from sb3_options.callbacks import CheckpointCallback, IntrinsicRewardCallback, SubgoalDiscoveryCallback
from sb3_options.checkpoints.file import read
from sb3_options.checkpoints.tree import State
from sb3_options.discovery.methods import DiscoveryMethod
from sb3_options.discovery.methods.random_places import RandomPlaces
from sb3_options.discovery.methods.relative_novelty import RelativeNovelty
from sb3_options.learning.dqn import OptionDQN
from sb3_options.learning.macro_q import MacroQ
from tests.integration.test_algorithms import ALGORITHMS, GAMMA, OFF_POLICY
from tests.support.sb3_helpers import TINY, fast_callback, make_optioned_rooms

STEPS = 1950
EVERY = 100


FAST = ["PPO", "OptionDQN"]
SLOW = ["MaskablePPO", "DQN", "QRDQN", "A2C", "TRPO", "RecurrentPPO", "MacroQ"]

Callbacks = list[BaseCallback]


def venv_of(n: int = 2, *, subproc: bool = False, wrap: Callable[[VecEnv], VecEnv] | None = None) -> VecEnv:
    made = [make_optioned_rooms] * n
    venv: VecEnv = SubprocVecEnv(made, start_method="fork") if subproc else DummyVecEnv(made)
    return venv if wrap is None else wrap(venv)


def model_of(name: str, venv: VecEnv, **kwargs: Any) -> Any:
    if name == "MacroQ":
        return MacroQ(venv, gamma=GAMMA, seed=0)
    algorithm = ALGORITHMS[name]
    if algorithm in OFF_POLICY:
        own = {} if algorithm is OptionDQN else {"replay_buffer_class": OptionReplayBuffer}
        exploring = {"exploration_fraction": 0.9, "exploration_final_eps": 0.8}
        return algorithm("MlpPolicy", venv, gamma=GAMMA, **{**TINY, **own, **exploring, **kwargs})
    policy, network = "MlpPolicy", {"net_arch": [16]}
    if name == "RecurrentPPO":
        policy, network = "MlpLstmPolicy", {"net_arch": [16], "lstm_hidden_size": 8}  # type: ignore[dict-item]  # of two kinds
    some: dict[str, Any] = {"batch_size": 64} if name != "A2C" else {}
    some |= {"n_epochs": 1} if "PPO" in name else {}
    return algorithm(policy, venv, n_steps=32, gamma=GAMMA, seed=0, policy_kwargs=network, **some, **kwargs)


def discovering(**kwargs: Any) -> SubgoalDiscoveryCallback:
    return fast_callback(max_new_options=2, option_settings={"grow": True}, **kwargs)


def trained(
    make: Callable[[], Any], callbacks: Callbacks, *, resume: Path | None = None, steps: int = STEPS
) -> tuple[Any, State]:
    """A model after training, from a checkpoint on if there is one, and everything that training is then."""
    model = make()
    *_, checkpoints = callbacks
    assert isinstance(checkpoints, CheckpointCallback)
    if resume is not None:
        checkpoints.resume_from(read(resume))
    log = {"log_interval": 1} if isinstance(model, OnPolicyAlgorithm) else {}  # a checkpoint at every rollout, if due
    model.learn(steps, callbacks, **log)
    state = checkpoints.state()
    for callback in state["callbacks"]:
        if callback["class"] == "CheckpointCallback":  # whose turn it is has no part in training
            callback["own"] = None
    model.get_env().close()
    return model, state


def check_resumes(
    make: Callable[[], Any],
    others: Callable[[], Callbacks],
    tmp_path: Path,
    cuts: Sequence[float] = (0.1, 0.7),
    steps: int = STEPS,
) -> tuple[Callbacks, list[Path]]:
    """Train, and train from some of the checkpoints on: the final states are equal."""
    callbacks = [*others(), CheckpointCallback(tmp_path / "whole", EVERY)]
    _, whole = trained(make, callbacks, steps=steps)
    files = sorted((tmp_path / "whole").glob("0*"))
    for cut in cuts:
        file = files[int(cut * len(files))]
        _, resumed = trained(make, [*others(), CheckpointCallback(tmp_path / "rest", 10**9)], resume=file, steps=steps)
        assert differing(whole, resumed) == [], f"resumed after {int(file.stem)} steps"
    return callbacks, files


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize("name", FAST)  # the others are in test_checkpoint_matrix.py
def test_every_algorithm_goes_on_as_if_never_ended(name: str, tmp_path: Path) -> None:
    check_resumes(lambda: model_of(name, venv_of()), lambda: [discovering()], tmp_path)


@pytest.mark.usefixtures("keep_all")
def test_rollouts_in_primitive_steps(tmp_path: Path) -> None:
    callbacks, _ = check_resumes(
        lambda: model_of("PPO", venv_of()),
        lambda: [discovering(use={"primitive_rollouts": True})],
        tmp_path,
        cuts=(0.1, 0.95),
    )
    model: Any = callbacks[0].model
    assert model.n_steps == 32


def filled(file: Path) -> list[int]:
    (discovery,) = (each["own"] for each in read(file)["callbacks"] if each["class"] == "SubgoalDiscoveryCallback")
    return [i for i, slot in enumerate(discovery["_installer"].state["slots"]) if slot is not None]


@pytest.mark.slow
@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize(
    ("name", "wrap"),
    [
        ("MaskablePPO", lambda venv: VecNormalize(venv, gamma=GAMMA)),
        ("PPO", lambda venv: VecNormalize(venv, gamma=GAMMA, norm_obs=False)),
        ("DQN", lambda venv: VecNormalize(venv, gamma=GAMMA, norm_reward=False)),
        ("PPO", lambda venv: VecFrameStack(venv, 2)),
    ],
)
def test_wrappers_of_vec_envs(name: str, wrap: Callable[[VecEnv], VecEnv], tmp_path: Path) -> None:
    check_resumes(lambda: model_of(name, venv_of(wrap=wrap)), lambda: [discovering()], tmp_path, cuts=(0.5,))


@pytest.mark.slow
@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize(
    "kwargs", [{"buffer_size": 300}, {"replay_buffer_kwargs": {"n_steps": 3}}], ids=["full", "n-step"]
)
def test_replay_buffers(kwargs: dict[str, Any], tmp_path: Path) -> None:
    check_resumes(lambda: model_of("DQN", venv_of(), **kwargs), lambda: [discovering()], tmp_path, cuts=(0.3, 0.8))


@pytest.mark.slow
@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize("kind", ["counts", "rnd", "noveld", "e3b"])
def test_bonuses(kind: Any, tmp_path: Path) -> None:
    others = lambda: [discovering(), IntrinsicRewardCallback(kind)]  # noqa: E731
    check_resumes(lambda: model_of("A2C", venv_of()), others, tmp_path, cuts=(0.5,))


@pytest.mark.usefixtures("keep_all")
def test_evaluations(tmp_path: Path) -> None:
    def others() -> Callbacks:
        env = venv_of(1)
        env.seed(7)
        return [
            discovering(),
            EveryNTimesteps(700, EvalCallback(env, n_eval_episodes=2, eval_freq=1, verbose=0, warn=False)),
        ]

    # Before the first evaluation, when its environment has still to be seeded, and after it.
    check_resumes(lambda: model_of("A2C", venv_of()), others, tmp_path, cuts=(0.1, 0.5))


@pytest.mark.usefixtures("keep_all")
@pytest.mark.parametrize("make", [RelativeNovelty, RandomPlaces])
def test_methods_of_discovery(make: Callable[..., DiscoveryMethod], tmp_path: Path) -> None:
    """Settings with which each makes an option in these few steps."""
    soon: dict[Any, dict[str, Any]] = {
        RelativeNovelty: {"lag": 2, "threshold": 1.0, "odds": 1.0},
        RandomPlaces: {"min_successes": 4},
    }
    callbacks, _ = check_resumes(
        lambda: model_of("A2C", venv_of()), lambda: [discovering(method=make(**soon[make]))], tmp_path, cuts=(0.2, 0.7)
    )
    assert callbacks[0].discoveries  # type: ignore[attr-defined]  # of discovery
