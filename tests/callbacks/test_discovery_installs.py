"""Options are discovered, reach every environment, and are used; settings that do not fit are refused."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_options.learning import heads
from sb3_options.options.option import SubgoalOption
from tests.callbacks.doorway import N_PRIMITIVE, STEPS, banks, model_of, same_options
from tests.support.sb3_helpers import DOORWAY, env_of, fast_callback, make_optioned_rooms, optioned_rooms


def test_discovers_the_doorway_and_installs_an_option_that_leads_there() -> None:
    """With DQN; the others are in tests/integration/test_algorithms.py."""
    callback, model = fast_callback(), model_of()
    model.learn(STEPS, callback=callback)
    (found,) = callback.discoveries
    assert np.abs(found.subgoal - DOORWAY).sum() <= 1
    assert found.slot == 0
    assert 0 < found.episode <= callback.episodes
    assert 0 < found.timestep <= model.num_timesteps == callback.num_timesteps
    assert found.initiation_states == len(cast("SubgoalOption", callback.bank[0]).initiation_set.points) > 5
    assert np.isfinite(found.log_density)
    assert same_options([callback.bank, *banks(env_of(model))])
    assert [heads.is_closed(model.policy, N_PRIMITIVE + i) for i in range(4)] == [False, True, True, True]

    # The option itself, from every cell of the left room.
    reached = []
    env = optioned_rooms()
    for x in range(4):
        for y in range(5):
            env.reset(seed=5 * x + y, options={"start": (x, y)})
            env.set_option(0, callback.bank[0])
            if env.action_masks()[N_PRIMITIVE]:
                _, _, _, _, info = env.step(N_PRIMITIVE)
                reached.append(info["option"]["termination"] == "subgoal")
    assert len(reached) > 5
    assert np.mean(reached) > 0.7


class TestReachesEveryEnvironment:
    def test_in_worker_processes(self) -> None:
        venv = SubprocVecEnv([make_optioned_rooms] * 2, start_method="fork")
        try:
            callback = fast_callback()
            model = model_of(venv)
            model.learn(STEPS, callback=callback)
            assert len(callback.discoveries) == 1
            assert same_options([callback.bank, *banks(venv)])
            # Bound to the feature map that each worker has.
            assert venv.env_method("available", np.eye(45, dtype=np.float32))[1][:, N_PRIMITIVE].sum() > 5
        finally:
            venv.close()

    @pytest.mark.parametrize("how", ["before", "deep"])
    def test_in_the_evaluation_beside_it(self, how: str) -> None:
        evaluation = EvalCallback(Monitor(optioned_rooms()), n_eval_episodes=1, eval_freq=100_000, verbose=0)
        callback = fast_callback()
        nested: dict[str, Callable[[], Any]] = {
            "before": lambda: [evaluation, callback],
            "deep": lambda: [CallbackList([EveryNTimesteps(50_000, CallbackList([evaluation]))]), callback],
        }
        model_of().learn(STEPS, callback=nested[how]())
        assert len(callback.discoveries) == 1
        assert same_options([callback.bank, *banks(evaluation.eval_env)])


class TestSuccess:
    def test_is_the_users(self) -> None:
        asked = []

        def never(trajectory: Any) -> bool:
            asked.append(len(trajectory))
            return False

        callback, model = fast_callback(success=never), model_of()
        model.learn(1000, callback=callback)
        assert len(asked) == callback.episodes > 5
        assert callback.discoveries == []


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([{"name": "a", "features": [7]}], "7"),
        ([{"name": "a", "features": [0], "present": [[7]]}], "present must be sets of its features"),
    ],
)
def test_groups_that_do_not_fit_are_refused_before_the_first_step(groups: list[Any], message: str) -> None:
    model = model_of()
    with pytest.raises(ValueError, match=message):
        model.learn(STEPS, callback=fast_callback(concepts={"groups": groups}))
    assert model.num_timesteps == 0
