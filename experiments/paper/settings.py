"""Every parameter of the paper's gridworld experiments, and whether the paper gives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from experiments.common.documents import described
from experiments.common.few_peaks import FewPeaks
from sb3_options.discovery.settings import DiscoverySettings
from sb3_options.options.settings import OptionLearningSettings

TRANSFER_GOAL = (20, 0)
"""Upper right corner, §6.1."""


@dataclass(frozen=True)
class PaperSettings:
    """The defaults of what the paper leaves open were chosen on seeds 0 to 99; reported seeds count from 4000.

    `IN_PAPER` says for each field what the paper says of it.
    """

    trials: int = 300
    epsilon: float = 0.1
    step_size: float = 0.05
    gamma: float = 0.9
    success_probability: float = 0.9
    goal_reward: float = 1.0
    options_per_run: int = 1
    step_limit: int | None = None

    decay: float = 0.8
    threshold: float = 0.3
    gaussian_scale: float = 1.0
    start_radius: float = 1.5
    goal_radius: float = 9.0
    min_positive: int = 8
    max_places: int = 1
    max_extent: float = 2.0
    search: Literal["exhaustive", "gradient"] = "exhaustive"

    initiation_steps: int = 50
    replay_sweeps: int = 20
    replay_order: Literal["forward", "backward"] = "forward"
    option_gamma: float = 0.9
    option_step_size: float = 0.1
    leave_reward: float = -10.0
    max_duration: int = 100
    keep_learning: bool = True

    histogram_trials: tuple[int, int] = (30, 40)
    density_trials: int = 25
    transfer_success_probability: float = 0.8
    transfer_trials: int = 100
    reuse_trials: int = 50
    control_trials: int = 200
    random_step_limit: int = 5000
    negative_step_limit: int = 2000
    negative_trials: int = 50

    def discovery(self, *, negative_strength: float | None = None, loops: bool = True) -> DiscoverySettings:
        """How subgoals are found.

        Args:
            negative_strength: η of negative bags; None goes without them.
            loops: The paper's bags and diverse density; else the library's own, without loops, of passages only.
        """
        bags: dict[str, Any] = {"loops": "keep", "min_passing": 0.0, "leak": 0.0}
        return DiscoverySettings(
            **(bags if loops else {}),
            capacity=max(self.trials, self.negative_trials),
            min_positive=self.min_positive,
            negative_strength=negative_strength or 0.0,
            search=self.search,
            search_growth=0.0,  # Table 1: after every trajectory
            scale=self.gaussian_scale,
            start_radius=self.start_radius,
            goal_radius=self.goal_radius,
            decay=self.decay,
            threshold=self.threshold,
        )

    def method(self) -> FewPeaks:
        """What tells bottlenecks from accidents in the paper's bags."""
        return FewPeaks(self.max_places, self.max_extent)

    def option(self) -> OptionLearningSettings:
        """How options are made."""
        return OptionLearningSettings(
            initiation_steps=self.initiation_steps,
            max_duration=self.max_duration,
            leave_reward=self.leave_reward,
            gamma=self.option_gamma,
            value_function="table",
            sweeps=self.replay_sweeps,
        )

    def described(self) -> dict[str, dict[str, Any]]:
        """For results.json."""
        return described(self, IN_PAPER)


IN_PAPER: dict[str, str | None] = {
    "trials": None,
    "epsilon": "§3: 0.1",
    "step_size": "§3: 0.05",
    "gamma": "§3: 0.9",
    "success_probability": "§6.1: 0.9, else a uniformly random direction",
    "goal_reward": "§3: 1 at the goal, 0 elsewhere",
    "options_per_run": "§6.1: one",
    "step_limit": "§6.1: none is mentioned",
    "decay": None,
    "threshold": None,
    "gaussian_scale": None,
    "start_radius": "§4: states around the start are excluded, no radius",
    "goal_radius": "§4: states around the goal are excluded, no radius",
    "min_positive": None,
    "max_places": None,
    "max_extent": None,
    "search": "§4: exhaustive",
    "initiation_steps": "§5: n, no value",
    "replay_sweeps": None,
    "replay_order": None,
    "option_gamma": None,
    "option_step_size": None,
    "leave_reward": "§5: can be negative, no value",
    "max_duration": None,
    "keep_learning": "§2: can be modified over time",
    "histogram_trials": "§3: the 30-40th trials",
    "density_trials": "§6.1: 25",
    "transfer_success_probability": "§6.1: 0.8",
    "transfer_trials": None,
    "reuse_trials": None,
    "control_trials": None,
    "random_step_limit": "§3: none is mentioned; ours favours the random option, which can hold a run for 10⁶ steps",
    "negative_step_limit": None,
    "negative_trials": None,
}
