"""A control of discovery: options to subgoals that are drawn from what stands out by its contrast."""

from __future__ import annotations

from sb3_options.callbacks import SubgoalDiscoveryCallback
from sb3_options.callbacks.checks import groups_here
from sb3_options.discovery.random_grouped import RandomGroupedDiscovery
from sb3_options.options.option import SubgoalOption


class ContrastingSubgoalsCallback(SubgoalDiscoveryCallback):
    """`SubgoalDiscoveryCallback` that draws subgoals from the states that diverse density searches."""

    def _on_training_start(self) -> None:
        if self.discovery is None:
            slots = self.training_env.get_attr("bank", [0])[0].slots
            self.discovery = RandomGroupedDiscovery(
                self.settings,
                groups=groups_here(self.groups, self.training_env),
                success=self.success,
                kind=self.training_env.get_attr("traits", [0])[0].feature_kind,
                taken=[option.subgoal for option in slots if isinstance(option, SubgoalOption)],
                contrasting=True,
                seed=self.seed,
            )
        super()._on_training_start()
