"""`OptionsVecEnv` against `OptionsWrapper`: each environment takes the same course, decision by decision."""

import hashlib
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from sb3_contrib.common.maskable.buffers import MaskableRolloutBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize

import sb3_options.envs  # noqa: F401  # registers them
from sb3_options import Option, OptionReplayBuffer, OptionRolloutBuffer, OptionsVecEnv, OptionsWrapper
from sb3_options.envs.minigrid import MiniGridWrapper
from sb3_options.experience.observations import flatten, take
from sb3_options.experience.option_run import OptionRun
from sb3_options.experience.trajectories import Trajectory
from sb3_options.learning.rollout_buffer import SMDPAdvantages
from tests.support.helpers import CountingEnv, equal, steady_option
from tests.support.sb3_helpers import TAXI, small_rooms

N_ENVS = 2
GAMMA = 0.9


def digest(observations: Any, salt: str) -> npt.NDArray[np.int64]:
    """A number for each observation, (batch,), that looks random."""
    rows = flatten(observations)
    keys = [hashlib.blake2b(row.tobytes() + salt.encode(), digest_size=4).digest() for row in rows]
    return np.array([int.from_bytes(key, "big") for key in keys])


def arbitrary_option(n_primitive: int, salt: str, *, max_duration: int) -> Option:
    """May start in most observations, and ends in some, in others by chance."""
    return Option(
        lambda obs: digest(obs, f"{salt} I") % 8 > 0,
        lambda obs: digest(obs, f"{salt} π") % n_primitive,
        lambda obs: np.array([0.0, 0.0, 0.0, 0.5, 1.0])[digest(obs, f"{salt} β") % 5],
        max_duration=max_duration,
        name=salt,
    )


def steps(venv: VecEnv) -> Iterator[Any]:
    """Observations, masks, actions, number of decisions so far, and what each step returns, without end.

    The choice in an environment follows from its observation, mask and number of decisions.
    """
    venv.seed(5)
    observations, n_decisions = venv.reset(), np.zeros(venv.num_envs, dtype=np.int64)
    while True:
        masks = np.stack(venv.env_method("action_masks"))
        allowed, numbers = map(np.flatnonzero, masks), digest(observations, "choice") + 7 * n_decisions
        actions = np.array([each[number % len(each)] for each, number in zip(allowed, numbers, strict=True)])
        result = venv.step(actions)
        yield observations, masks, actions, n_decisions, result
        observations = result[0]
        n_decisions = n_decisions + [info["option"]["termination"] != "running" for info in result[3]]


class Decision(NamedTuple):
    """What an algorithm is told of one decision."""

    observation: Any
    mask: npt.NDArray[np.bool_]
    action: int
    reward: float
    arrived: Any
    done: bool
    run: dict[str, Any]
    trajectories: list[Trajectory]


def decisions(venv: VecEnv, n_steps: int) -> list[list[Decision]]:
    """Those of each environment."""
    made: list[list[Decision]] = [[] for _ in range(venv.num_envs)]
    cut: list[list[Trajectory]] = [[] for _ in range(venv.num_envs)]  # segments since the last decision
    begun: dict[int, npt.NDArray[np.bool_]] = {}  # by environment, the mask when its option was chosen
    for observations, masks, actions, _, (later, rewards, dones, infos) in islice(steps(venv), n_steps):
        for env, info in enumerate(infos):
            run = dict(info["option"])
            cut[env] += info.get("segments", ())
            if run["termination"] == "running":
                assert (run["duration"], run["discount"], rewards[env], dones[env]) == (0, 1.0, 0.0, False)
                assert equal(take(later, env), take(observations, env))
                begun.setdefault(env, masks[env])
                continue
            assert run.pop("chosen", actions[env]) == actions[env]
            arrived = info["terminal_observation"] if dones[env] else take(later, env)
            told = [info["trajectory"]] if "trajectory" in info else cut[env]
            cut[env] = []
            first = take(observations, env)
            made[env].append(
                Decision(first, begun.pop(env, masks[env]), actions[env], rewards[env], arrived, dones[env], run, told)
            )
    venv.close()
    return made


CASES: dict[str, Callable[[], gym.Env[Any, Any]]] = {
    "rooms": small_rooms,
    "TwoRooms": lambda: gym.make("sb3_options/TwoRooms-v0", max_steps=60),
    "FourRooms, picture": lambda: gym.make("sb3_options/FourRooms-v0", observation="image", max_steps=60),
    "KeyDoor": lambda: gym.make("sb3_options/KeyDoor-v0", observation="xy", max_steps=60),
    "Taxi": lambda: gym.make(TAXI, max_episode_steps=50),
    "MiniGrid": lambda: MiniGridWrapper(gym.make("minigrid:MiniGrid-DoorKey-5x5-v0", max_steps=60)),
    "Pioneer": lambda: gym.make("sb3_options/Pioneer-v0", max_steps=20),
    "CartPole": lambda: gym.make("CartPole-v1"),
    "counting": lambda: CountingEnv(3, terminate_at=17),
    "counting, cut off": lambda: CountingEnv(3, truncate_at=11),
}


def both(make: Callable[[], gym.Env[Any, Any]], *, n_envs: int = N_ENVS, **kwargs: Any) -> tuple[VecEnv, OptionsVecEnv]:
    """The same environments in either way."""
    single = DummyVecEnv([lambda: OptionsWrapper(make(), gamma=GAMMA, **kwargs) for _ in range(n_envs)])
    return single, OptionsVecEnv(DummyVecEnv([make for _ in range(n_envs)]), gamma=GAMMA, **kwargs)


@pytest.mark.parametrize(("reports", "max_runs"), [(False, None), (True, 2)])
@pytest.mark.parametrize("make", CASES.values(), ids=CASES.keys())
def test_every_environment_takes_the_same_course(
    make: Callable[[], gym.Env[Any, Any]], reports: bool, max_runs: int | None
) -> None:
    single, batched = both(make, max_runs=max_runs)
    n_primitive = single.get_attr("traits")[0].n_primitive
    options = {slot: arbitrary_option(n_primitive, f"option {slot}", max_duration=9 - 2 * slot) for slot in (0, 1, 3)}
    for venv in (single, batched):
        venv.env_method("set_slots", options=options, record=True, report_availability=reports, expect_empty=True)
    expected, got = decisions(single, 105), decisions(batched, 420)
    assert {"primitive", "subgoal"} < {decision.run["termination"] for of_env in expected for decision in of_env}
    for of_single, of_batched in zip(expected, got, strict=True):
        n = min(len(of_single), len(of_batched))
        assert n >= 100
        assert alike(of_single[:n], of_batched[:n])


def alike(one: Any, other: Any) -> bool:
    """Equality, but for types: a `VecEnv` has those of its space, an environment others."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, Decision | list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, Trajectory):
        return alike(vars(one), vars(other))
    if isinstance(one, str) or one is None:
        return bool(one == other)
    return np.allclose(one, other, rtol=1e-6)


def in_two_parts() -> gym.Env[Any, Any]:
    env = CountingEnv(3, terminate_at=17)
    parts = gym.spaces.Dict({"where": env.observation_space, "again": env.observation_space})
    return gym.wrappers.TransformObservation(env, lambda seen: {"where": seen, "again": seen}, parts)


def test_observations_may_have_parts_and_trajectories_be_cut_at_peaks_of_reward() -> None:
    single, batched = both(in_two_parts, feature_map=flatten)
    option = arbitrary_option(3, "option", max_duration=5)
    for venv in (single, batched):
        venv.env_method("set_slots", options={0: option}, record=True, max_segment=4, expect_empty=True)
    expected, got = decisions(single, 60), decisions(batched, 300)
    assert any(decision.trajectories for decision in expected[0])
    for of_single, of_batched in zip(expected, got, strict=True):
        n = min(len(of_single), len(of_batched))
        assert alike(of_single[:n], of_batched[:n])


TWO_OPTIONS = {0: arbitrary_option(4, "one", max_duration=6), 1: arbitrary_option(4, "other", max_duration=3)}


def test_a_replay_buffer_gets_the_same_rows() -> None:
    buffers = []
    for venv in both(small_rooms, n_envs=1):
        venv.env_method("set_slots", options=TWO_OPTIONS, report_availability=True, expect_empty=True)
        buffer = OptionReplayBuffer(400, venv.observation_space, venv.action_space, n_envs=1, n_steps=3)
        buffer.track_availability(4)
        for observations, _, action, _, (later, rewards, dones, infos) in steps(venv):
            told = np.where(dones[:, None], infos[0].get("terminal_observation", 0), later)
            # What an algorithm without masks chooses while its environment waits does not count.
            given = action if infos[0]["option"].get("chosen") is None else np.zeros(1, dtype=np.int64)
            buffer.add(observations, told, given, rewards, dones, infos)
            if buffer.full:
                break
        buffers.append(buffer)
    assert (buffers[0].actions >= 4).sum() > 10
    for one, other in zip(*(buffer._columns() for buffer in buffers), strict=True):
        np.testing.assert_array_equal(one, other)


class Buffer(SMDPAdvantages, MaskableRolloutBuffer):
    """As MaskablePPO's becomes."""


def test_a_rollout_buffer_learns_of_the_same_decisions() -> None:
    n_steps, learned = 40, []
    for venv in both(lambda: CountingEnv(4, terminate_at=17), n_envs=1):
        venv.env_method("set_slots", options=TWO_OPTIONS, expect_empty=True)
        buffer = Buffer(n_steps, venv.observation_space, venv.action_space, gamma=GAMMA, gae_lambda=0.8)
        started, taken = np.ones(1), steps(venv)
        kept: list[Any] = []
        for _ in range(10):
            buffer.reset()
            for observations, masks, action, n_decisions, (_, rewards, dones, infos) in islice(taken, n_steps):
                run = OptionRun.from_info(infos[0])
                buffer.expect(rewards, [run])
                value = torch.as_tensor(digest(observations, "value") % 100 / 100.0)
                chance = torch.as_tensor(n_decisions.astype(np.float64))  # other numbers for other decisions
                waiting = run.chosen is not None and run.duration > 1
                given = np.zeros_like(action) if waiting else action  # without masks anything may be chosen there
                buffer.add(observations, given[:, None], rewards, started, value, chance, action_masks=masks)
                started = dones.astype(float)
            buffer.compute_returns_and_advantage(torch.zeros(1), dones)
            (batch,) = buffer.get()
            order = np.argsort(batch.old_log_prob.numpy())
            kept.append([part.numpy()[order] for part in batch])
        venv.close()
        learned.append([np.concatenate(parts) for parts in zip(*kept, strict=True)])
    n = min(len(parts[0]) for parts in learned)
    assert n > 120
    for name, one, other in zip(batch._fields, *learned, strict=True):
        if name in ("advantages", "returns"):  # those near the end of a rollout see less of what follows
            assert np.isclose(one[:n], other[:n], rtol=1e-4, atol=1e-4).mean() > 0.5
        elif name == "old_log_prob":
            np.testing.assert_array_equal(other[:n], np.arange(n))
        else:
            np.testing.assert_array_equal(one[:n], other[:n], err_msg=name)


def counting(max_options: int = 1, *, n_envs: int = 1, **kwargs: Any) -> OptionsVecEnv:
    return OptionsVecEnv(DummyVecEnv([lambda: CountingEnv(2, **kwargs)] * n_envs), max_options, gamma=GAMMA)


def test_a_rollout_in_which_nothing_ends_teaches_nothing() -> None:
    venv = counting()
    venv.set_slots(options={0: steady_option(1, max_duration=50)})
    buffer = OptionRolloutBuffer(4, venv.observation_space, venv.action_space, gamma=GAMMA)
    observations: Any = venv.reset()
    for _ in range(4):
        later, rewards, dones, infos = venv.step(np.array([2]))
        buffer.expect(rewards, [OptionRun.from_info(infos[0])])
        buffer.add(observations, np.array([[2]]), rewards, np.zeros(1), torch.ones(1), torch.zeros(1))
        observations = later
    buffer.compute_returns_and_advantage(torch.ones(1), dones)
    (batch,) = buffer.get()
    assert (batch.advantages.tolist(), batch.returns.tolist()) == ([0.0] * 2, batch.old_values.tolist())


def test_options_that_are_closed_or_replaced_while_they_run_go_on_to_their_end() -> None:
    venv = counting(2, n_envs=2)
    venv.set_slots(options={0: steady_option(1, max_duration=3), 1: steady_option(1, max_duration=3)})
    venv.reset()
    infos = venv.step(np.array([2, 3]))[-1]
    assert [info["option"]["duration"] for info in infos] == [0, 0]
    venv.set_slots(options={0: None, 1: steady_option(0, max_duration=2)})
    venv.set_slots(options={0: steady_option(0, max_duration=2)})  # another one
    assert venv.action_masks().tolist() == [[False, False, True, False], [False, False, False, True]]
    venv.step(np.array([0, 0]))
    _, rewards, _, infos = venv.step(np.array([0, 0]))
    closed, replaced = (info["option"] for info in infos)
    assert (closed["index"], closed["duration"], closed["termination"]) == (-1, 3, "running")
    assert (replaced["index"], replaced["duration"], replaced["termination"]) == (1, 3, "max_duration")
    assert replaced["actions"].tolist() == [1, 1, 1]
    np.testing.assert_allclose(rewards, 1 + GAMMA * 2 + GAMMA**2 * 3)


def test_options_that_are_put_into_the_bank_itself_count_at_once() -> None:
    venv = counting()
    venv.reset()
    assert venv.action_masks().tolist() == [[True, True, False]]
    venv.bank.add(steady_option(1, max_duration=3), 0)
    assert venv.action_masks().tolist() == [[True, True, True]]
    assert venv.step(np.array([2]))[-1][0]["option"]["duration"] == 0  # goes on
    venv.bank.remove(0)
    venv.reset()
    assert venv.action_masks().tolist() == [[True, True, False]]


@pytest.mark.parametrize("change", [lambda bank: bank.remove(0), lambda bank: bank.add(steady_option(0), 0)])
def test_a_change_of_the_bank_itself_leaves_runs_alone(change: Callable[[Any], Any]) -> None:
    venv = counting()
    venv.bank.add(steady_option(1, max_duration=3), 0)
    venv.reset()
    venv.step(np.array([2]))
    change(venv.bank)
    venv.step(np.array([0]))
    run = venv.step(np.array([0]))[-1][0]["option"]
    assert (run["actions"].tolist(), run["termination"]) == ([1, 1, 1], "max_duration")


def test_options_are_not_asked_where_an_episode_ended() -> None:
    seen: list[float] = []

    def noting(observations: Any) -> Any:
        seen.extend(np.ravel(observations).tolist())
        return np.ones(len(observations), dtype=bool)

    venv = counting(n_envs=2, terminate_at=2)
    option = Option(noting, lambda obs: np.ones(len(obs), dtype=int), lambda obs: ~noting(obs), max_duration=9)
    venv.set_slots(options={0: option})
    venv.reset()
    venv.step(np.array([2, 2]))
    *_, dones, infos = venv.step(np.array([2, 2]))
    assert dones.all()
    assert seen
    assert {info["terminal_observation"].item() for info in infos}.isdisjoint(seen)


def test_an_entry_of_the_environment_where_trajectories_are_written_is_refused_at_once() -> None:
    venv = counting(step=lambda *_: (np.zeros(1), 0.0, False, False, {"trajectory": "own"}))
    venv.set_slots(record=True)
    venv.reset()
    with pytest.raises(ValueError, match=r'info\["trajectory"\] of its own'):
        venv.step(np.array([0]))


def test_a_slot_that_may_not_start_runs_a_primitive() -> None:
    single, together = both(small_rooms)
    for venv in (single, together):
        venv.seed(5)
        venv.reset()
    n = together.n_primitive
    for actions in ([n + 3, n + 2], [n + 1, n + 3]):
        one, other = single.step(np.array(actions)), together.step(np.array(actions))
        assert equal(one[0], other[0])
        assert [info["option"]["actions"].tolist() for info in other[3]] == [
            [slot % n] for slot in np.array(actions) - n
        ]


def test_an_option_that_has_run_often_enough_runs_a_primitive() -> None:
    _, venv = both(small_rooms, n_envs=1, max_runs=1)
    venv.bank.add(steady_option(1, max_duration=2))
    venv.reset()
    chosen = np.array([venv.n_primitive])
    runs = [venv.step(chosen)[3][0]["option"] for _ in range(3)]
    assert [(run["index"], run["duration"]) for run in runs] == [(-1, 0), (0, 2), (-1, 1)]
    assert venv.env_method("get_wrapper_attr", "spec", indices=[0]) == [None]  # a method of the environments


def test_random_trajectories_are_truncated_and_leave_the_slots_as_they_were() -> None:
    _, venv = both(small_rooms)
    trajectories = venv.random_trajectories(3, 4, seed=0)
    assert [len(each) for each in trajectories] == [4, 4, 4]
    assert all(each.truncated and not each.terminated for each in trajectories)
    assert len({tuple(each.actions) for each in trajectories}) == 3
    assert not venv.slot_state.record


def test_features_of_the_environments_themselves_are_the_default() -> None:
    class Mapped(VecEnvWrapper):
        def concept_features(self, observations: Any) -> Any:
            return flatten(observations)[:, :2] * 3.0

        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            return self.venv.step_wait()

    bare = DummyVecEnv([lambda: CountingEnv(3)])
    venv = OptionsVecEnv(Mapped(bare), gamma=GAMMA)
    first = venv.reset()
    np.testing.assert_array_equal(venv.concept_features(first), flatten(first)[:, :2] * 3.0)


def test_sums_of_whole_rewards_are_not_cut() -> None:
    class Whole(DummyVecEnv):
        def step_wait(self) -> Any:
            observations, rewards, dones, infos = super().step_wait()
            return observations, rewards.astype(np.int64), dones, infos

    venv = OptionsVecEnv(Whole([lambda: CountingEnv(2)]), 1, gamma=GAMMA)
    venv.set_slots(options={0: steady_option(max_duration=2)})
    venv.reset()
    venv.step(np.array([2]))
    assert venv.step(np.array([2]))[1].tolist() == [1 + GAMMA * 2]


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="VecNormalize beneath OptionsVecEnv"):
        OptionsVecEnv(VecNormalize(DummyVecEnv([CountingEnv])))
    with pytest.raises(TypeError, match="OptionsVecEnv needs a Discrete action space"):
        OptionsVecEnv(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    venv = counting()
    venv.reset()
    with pytest.raises(ValueError, match="actions must be between 0 and 2"):
        venv.step(np.array([3]))
