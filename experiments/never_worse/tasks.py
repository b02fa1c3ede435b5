"""The tasks, named before the first run: no setting of the library was chosen on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
from gymnasium.wrappers import DiscretizeAction, TimeLimit

from sb3_options.experience.observations import FloatArray, Observations

POINT_MAZE, CLIFF = "experiments/PointMaze-v0", "experiments/CliffWalking-v0"
U_TURN = [[1, 1, 1, 1, 1], [1, "r", 0, 0, 1], [1, 1, 1, 0, 1], [1, "g", 0, 0, 1], [1, 1, 1, 1, 1]]
CLIFF_STEPS = 200


@dataclass(frozen=True)
class Unseen:
    """A task.

    Attributes:
        env: Gymnasium id.
        frames: Primitive steps of a training.
        level: Mean return of `WINDOW` episodes from which on the task counts as learned: four fifths of the way from
            the first to the last tenth of two trainings without discovery, seeds 100 and 101. In PointMaze, where
            neither had a success, half of the episodes.
        settings: Of `configure`, which a user would give.
    """

    env: str
    frames: int
    level: float
    settings: dict[str, Any] = field(default_factory=dict)


WINDOW = 50

TASKS = {
    "SimpleCrossingS9N1": Unseen("MiniGrid-SimpleCrossingS9N1-v0", 60_000, 0.10),
    "LavaCrossingS9N1": Unseen("MiniGrid-LavaCrossingS9N1-v0", 60_000, 0.11),
    "DistShift1": Unseen("MiniGrid-DistShift1-v0", 60_000, 0.38),
    "GoToDoor-5x5": Unseen("MiniGrid-GoToDoor-5x5-v0", 60_000, 0.21),
    "Dynamic-Obstacles-6x6": Unseen("MiniGrid-Dynamic-Obstacles-6x6-v0", 60_000, 0.52),
    "FrozenLake": Unseen("FrozenLake-v1", 50_000, 0.35),
    "Taxi": Unseen("Taxi-v4", 60_000, -226.0),
    "CliffWalking": Unseen(CLIFF, 50_000, -104.0),
    "Acrobot": Unseen("Acrobot-v1", 60_000, -166.0),
    "PointMaze": Unseen(POINT_MAZE, 60_000, 0.5, {"discovery": {"scale": 4.0}, "option": {"policy_input": "features"}}),
}


class BallsPosition(gym.Wrapper[Any, Any, Any, Any]):
    """Gives PointMaze the concept features of docs/guide/concept-features.md: where the ball is."""

    def concept_features(self, observations: Observations) -> FloatArray:
        """Metres, (batch, 2)."""
        return cast("dict[str, FloatArray]", observations)["achieved_goal"]


def point_maze() -> gym.Env[Any, Any]:
    """The U-turn, with nine actions."""
    import gymnasium_robotics  # type: ignore[import-untyped]

    gym.register_envs(gymnasium_robotics)
    env = gym.make("PointMaze_UMaze-v3", maze_map=U_TURN, continuing_task=False)
    return BallsPosition(DiscretizeAction(env, bins=3, multidiscrete=False))


def cliff() -> gym.Env[Any, Any]:
    """Gymnasium's has no limit: a random walk takes thousands of steps."""
    return TimeLimit(gym.make("CliffWalking-v1"), CLIFF_STEPS)


gym.register(POINT_MAZE, entry_point="experiments.never_worse.tasks:point_maze")
gym.register(CLIFF, entry_point="experiments.never_worse.tasks:cliff")
