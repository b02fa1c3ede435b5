"""What discovery tells: printed, logged as text, in a file of options and in TensorBoard."""

import logging
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio.v3 as iio
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from sb3_options import OptionsWrapper
from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.summaries import log_run
from sb3_options.experience.option_run import OptionRun, Termination
from sb3_options.options import creation
from tests.callbacks.doorway import STEPS, model_of, same_options
from tests.support.sb3_helpers import FAST_DISCOVERY, fast_callback, n_colours, optioned_rooms, small_rooms


class SilentFailures(gym.Wrapper[Any, Any, Any, Any]):
    """Says whether an episode succeeded where it did."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if not info.get("is_success"):
            info.pop("is_success", None)
        return obs, float(reward), terminated, truncated, info


@pytest.mark.parametrize("n_envs", [1, 3])
def test_failures_before_the_first_reported_success_are_logged_with_it(n_envs: int) -> None:
    venv = DummyVecEnv([lambda: OptionsWrapper(SilentFailures(small_rooms(max_steps=60)), 1, gamma=0.9)] * n_envs)
    callback, model = SubgoalDiscoveryCallback(max_new_options=0), model_of(venv)
    for _ in range(2):  # the second training forgets what the first has logged
        began = len(callback.history)
        model.learn(4000, callback=callback)
        successes = [each.success for each in callback.history[began:]]
        assert not successes[0]
        assert any(successes)
        assert list(model.ep_success_buffer) == successes[-100:]


def test_a_subgoal_that_nothing_leads_to_is_told_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(creation, "MIN_REACH", 1.0)
    groups = [{"name": "place", "features": [0, 1], "labels": ["row", "column"]}]
    callback = fast_callback(concepts={"groups": groups}, option_settings={"value_function": "table"})
    with caplog.at_level(logging.WARNING, "sb3_options"):
        model_of(seed=0).learn(4 * STEPS, callback=callback)
    assert callback.discovery is not None
    assert callback.discovery.diary.n_withdrawn > 1
    said = [record.getMessage() for record in caplog.records if "No option for" in record.getMessage()]
    assert said
    assert len(said) == len(set(said)) < callback.discovery.diary.n_withdrawn


class TestSavePath:
    def test_is_written_at_each_new_option(self, tmp_path: Path) -> None:
        path = tmp_path / "deep" / "options.safetensors"
        written: list[tuple[bool, int]] = []
        callback = fast_callback()
        callback.save_path = path

        class Look(BaseCallback):
            def _on_step(self) -> bool:
                written.append((path.exists(), len(callback.discoveries)))
                return True

        model_of().learn(STEPS, callback=[callback, Look()])
        assert set(written) == {(False, 0), (True, 1)}
        bank = optioned_rooms().bank
        bank.load(path)
        assert same_options([bank, callback.bank])

    @pytest.mark.parametrize(
        ("asked", "why", "said"),
        [
            ({"verbose": 1}, "No subgoal was discovered: no episode has ended", True),
            ({"verbose": 0}, "No subgoal was discovered: no episode has ended", False),
            ({"verbose": 1, "max_new_options": 0}, "Discovery was switched off.", False),
        ],
    )
    def test_says_in_the_end_why_there_is_none(
        self, capsys: pytest.CaptureFixture[str], asked: dict[str, Any], why: str, said: bool
    ) -> None:
        callback = fast_callback(**asked)
        model_of().learn(20, callback=callback)
        assert (callback.why_nothing() or "").startswith(why)
        assert (why in capsys.readouterr().out) is said


@pytest.fixture(scope="module")
def events(tmp_path_factory: pytest.TempPathFactory) -> tuple[EventAccumulator, Any]:
    """What a run left for TensorBoard, and its model."""
    log = tmp_path_factory.mktemp("log")
    model = model_of(tensorboard_log=str(log))
    slower = SubgoalDiscoveryCallback({**FAST_DISCOVERY, "decay": 0.8}, max_new_options=1)
    model.learn(STEPS, callback=slower)
    (file,) = log.rglob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(file), size_guidance={"images": 0, "scalars": 0})
    accumulator.Reload()
    return accumulator, model


class TestTensorBoard:
    def last(self, events: EventAccumulator, tag: str) -> float:
        return float(events.Scalars(tag)[-1].value)

    def test_scalars(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, model = events
        tags = set(accumulator.Tags()["scalars"])
        assert tags >= {
            "slots/filled", "slots/0/inside", "slots/0/duration", "slots/0/ended_subgoal",
            "time/primitive_steps", "search/seconds", "search/leading_average", "search/best_log_density",
        }  # fmt: skip
        assert accumulator.Scalars("slots/filled")[0].value == 0
        assert self.last(accumulator, "slots/filled") == 1
        assert 0 < self.last(accumulator, "search/seconds") < 60
        assert self.last(accumulator, "slots/0/duration") > 1
        assert max(s.value for s in accumulator.Scalars("search/leading_average")) > 0
        shares = [self.last(accumulator, t) for t in tags if t.startswith("slots/0/ended_")]
        assert sum(shares) == pytest.approx(1.0)
        for event in accumulator.Scalars("time/primitive_steps"):
            assert event.value <= event.step <= model.num_timesteps
        assert accumulator.Scalars("slots/filled")[-1].step == model.num_timesteps

    def test_images(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, _ = events
        assert accumulator.Tags()["images"] == ["search/subgoals"]
        picture = iio.imread(accumulator.Images("search/subgoals")[-1].encoded_image_string)
        assert n_colours(picture[:, :, :3]) > 10

    def test_settings(self, events: tuple[EventAccumulator, Any]) -> None:
        accumulator, model = events
        told = accumulator.PluginTagToContent("hparams")
        settings = HParamsPluginData.FromString(told["_hparams_/session_start_info"]).session_start_info.hparams
        assert settings["algo"].string_value == type(model).__name__
        assert settings["discovery.decay"].number_value == 0.8
        # TensorBoard opens the first groups by the alphabet: the learning curve is to be among them.
        assert min(tag.partition("/")[0] for tag in accumulator.Tags()["scalars"]) == "rollout"


def test_steps_outside_the_initiation_set_are_no_runs(tmp_path: Path) -> None:
    log = configure(str(tmp_path), [])
    for duration, ending in ((5, "subgoal"), (3, "truncated"), (4, "subgoal")):
        log_run(log, OptionRun(2, duration, 0.9**duration, 0.9, cast("Termination", ending), inside=True))
    log_run(log, OptionRun(2, 1, 0.9, 0.9, "left_initiation", inside=False))
    logged = log.name_to_value
    assert (logged["slots/2/inside"], logged["slots/2/duration"]) == (0.75, 4.0)
    shares = {tag: value for tag, value in logged.items() if "ended_" in tag and value}
    assert shares == pytest.approx({"slots/2/ended_subgoal": 2 / 3, "slots/2/ended_truncated": 1 / 3})
