"""The Pioneer's twin in MuJoCo: the same task, body, actions and senses."""

from __future__ import annotations

from typing import Any

from sb3_options.envs.pioneer.env import PioneerTask
from sb3_options.envs.pioneer.mujoco_simulator import MuJoCoSimulator
from sb3_options.state import restore, state_of


class PioneerMuJoCo(PioneerTask):
    """The robot in MuJoCo, which has wheels for every Python. It takes the arguments of `PioneerTask`.

    Options learned in `Pioneer` work in it, and vice versa. It has no window, so no render mode ``"human"``. It can
    save and restore its state, so training resumes in mid-episode without repeating the episode.
    """

    metadata = {**PioneerTask.metadata, "render_modes": ["rgb_array", "rgb_array_list"]}  # noqa: RUF012

    STATE = ("_placement", "_robot", "_deposited", "_sensed", "_elapsed", "_over", "_ticks")

    simulator: MuJoCoSimulator

    def get_state(self) -> dict[str, Any]:
        """Return the state of the episode, for `set_state`, without ``np_random``."""
        built = self._placement is not None and not self._closed
        return {**state_of(self), "physics": self.simulator.get_state() if built else None}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, in an environment made with the same arguments."""
        self._refuse_if_closed("set_state")
        restore(self, state)
        self._pictures = []
        if self._placement is None or state["physics"] is None:
            self._placement = None
            return
        self.simulator.build(self._placement, self._arena.walls, self._arena.obstacles(self._placement))
        self.simulator.set_state(state["physics"])

    def _make_simulator(self, *, window: bool) -> MuJoCoSimulator:
        return MuJoCoSimulator()
