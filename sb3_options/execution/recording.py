"""`RecordTrajectories`: a wrapper beneath `OptionsWrapper` that records primitive steps."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_options.experience.recording import SegmentRecorder, TrajectoryRecorder
from sb3_options.experience.success import success_in
from sb3_options.experience.trajectories import Trajectory


class RecordTrajectories(gym.Wrapper[Any, Any, Any, Any]):
    """Records the primitive steps of an environment, and changes nothing.

    `OptionsWrapper` puts it beneath itself when recording is first requested, and takes the ``finished`` trajectories
    from it.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.recorder: TrajectoryRecorder | None = None
        self.max_segment: int | None = None
        self.finished: list[Trajectory] = []

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in gym.Wrapper, too
        """Spec of the environment: ``gym.make`` must not recreate the recording."""
        return self.env.spec

    def set(self, record: bool, max_segment: int | None, observation: Any) -> None:
        """Set whether to record, and segments or episodes. The current recording goes on if nothing changes."""
        if not record:
            self.recorder = None
            self.finished = []
        elif self.recorder is None or max_segment != self.max_segment:
            self.max_segment = max_segment
            self.recorder = recorder_for(max_segment)
            self.finished = self.recorder.finished
            if observation is not None:
                self.recorder.begin(observation)

    def take(self) -> dict[str, Any]:
        """Return the finished trajectories as entries of ``info``, and remove them."""
        report = {} if self.recorder is None else self.recorder.report()
        self.finished.clear()
        return report

    def get_state(self) -> dict[str, Any]:
        """Return the unfinished recording, for a checkpoint."""
        recorder = None if self.recorder is None else self.recorder.get_state()
        return {"recorder": recorder, "max_segment": self.max_segment}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state from `get_state`."""
        self.recorder = None
        self.set(state["recorder"] is not None, state["max_segment"], None)
        if self.recorder is not None:
            self.recorder.set_state(state["recorder"])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and forget the unfinished recording."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self.recorder is not None:
            self.recorder.begin(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one primitive step."""
        result = self.env.step(action)
        if self.recorder is None:
            return result
        observation, reward, terminated, truncated, info = result
        refuse_own(info, "trajectory", "segments")
        self.recorder.record(action, float(reward), observation)
        if terminated or truncated:
            self.recorder.end(terminated=terminated, truncated=truncated, is_success=success_in(info))
        return result


def recorder_for(max_segment: int | None) -> TrajectoryRecorder:
    """Return a recorder of segments, or of episodes without ``max_segment``."""
    return TrajectoryRecorder() if max_segment is None else SegmentRecorder(max_segment)


def refuse_own(info: Mapping[str, Any], *names: str) -> None:
    """Refuse an environment whose ``info`` has entries that `OptionsWrapper` writes."""
    for name in names:
        if name in info:
            raise ValueError(
                f'The environment has an info["{name}"] of its own, where OptionsWrapper writes: give it another name '
                "there, and wrap in OptionsWrapper once only."
            )
