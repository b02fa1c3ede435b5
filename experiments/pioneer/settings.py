"""Every parameter of the robot experiments, and whether the paper gives it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from experiments.common.documents import described
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.settings import OptionLearningSettings

TASKS = {
    "corner": "sb3_options/PioneerCorner-v0",
    "clutter": "sb3_options/PioneerClutter-v0",
    "two_balls": "sb3_options/PioneerTwoBalls-v0",
}
"""The tasks to which the option is taken."""

MAIN_TASK = "sb3_options/Pioneer-v0"


@dataclass(frozen=True)
class PioneerSettings:
    """The defaults of what the paper leaves open were chosen on seeds 0 to 7; reported seeds count from 1000.

    Lengths are in m, angles in rad. `IN_PAPER` says for each field what the paper says of it.
    """

    trials: int = 200
    transfer_trials: int = 30
    evaluation_trials: int = 100
    step_limit: int = 500
    epsilon: float = 0.1
    evaluation_epsilon: float = 0.02
    step_size: float = 0.1
    gamma: float = 0.95
    options_per_run: int = 1

    n_tilings: int = 8
    ball_tiles: tuple[int, int] = (12, 6)
    sonar_tiles: int = 5
    sonars: tuple[int, ...] = (1, 3, 5)
    sonar_horizon: float = 2.5

    decay: float = 0.8
    threshold: float = 0.6
    gaussian_width: float = math.radians(5)
    min_positive: int = 8

    policy_input: Literal["observation", "features"] = "features"
    subgoal_radius: float = 1.0
    initiation_steps: int = 20
    initiation_radius: float = 3.0
    option_gamma: float = 0.95
    leave_reward: float = -10.0
    max_duration: int = 20

    def discovery(self) -> DiscoverySettings:
        """How subgoals are found: one unit of concept space is ``gaussian_width``."""
        return DiscoverySettings(
            capacity=self.trials,
            min_positive=self.min_positive,
            negative_strength=0.0,
            loops="keep",
            min_passing=0.0,
            leak=0.0,
            search="exhaustive",
            search_growth=0.0,
            max_share=None,  # a step of the robot takes much longer than is assumed for a table
            scale=1 / self.gaussian_width,
            decay=self.decay,
            threshold=self.threshold,
            subgoal_radius=self.subgoal_radius,
        )

    def option(self) -> OptionLearningSettings:
        """How options are made; ``initiation_radius`` and ``subgoal_radius`` are in units of ``gaussian_width``."""
        return OptionLearningSettings(
            policy_input=self.policy_input,
            initiation_steps=self.initiation_steps,
            initiation_radius=self.initiation_radius,
            max_duration=self.max_duration,
            leave_reward=self.leave_reward,
            gamma=self.option_gamma,
            value_function="network",
            grow=False,
        )

    def described(self) -> dict[str, dict[str, Any]]:
        """For results.json."""
        return described(self, IN_PAPER)


IN_PAPER: dict[str, str | None] = {
    "options_per_run": "§7: one",
    "n_tilings": "§7: a CMAC, no sizes",
    "gamma": "§3: 0.9, for the gridworlds",
    "epsilon": "§3: 0.1, for the gridworlds",
    "step_size": "§3: 0.05, for the gridworlds",
    "leave_reward": "§5: can be negative, no value",
    "initiation_steps": "§5: n, no value",
}
"""What the paper says of a setting; of all others it says nothing."""
