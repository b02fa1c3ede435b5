"""`SubgoalDiscoveryCallback` for rl-zoo3."""

from sb3_options.callbacks.discovery import SubgoalDiscoveryCallback
from sb3_options.callbacks.tree import evaluation_envs
from sb3_options.zoo import ZooOptionsWrapper


class ZooDiscoveryCallback(SubgoalDiscoveryCallback):
    """`SubgoalDiscoveryCallback`, with its arguments, for environments in `ZooOptionsWrapper`.

    The environments discount by the algorithm's γ, which a hyperparameter search draws. rl-zoo3 saves the options in
    the model's zip. The wrapper finds them there when the run is played.
    """

    def _on_training_start(self) -> None:
        for venv in (self.training_env, *evaluation_envs(self.locals.get("callback"))):
            if all(venv.env_is_wrapped(ZooOptionsWrapper)):
                venv.env_method("discount_with", self.model.gamma)  # type: ignore[attr-defined]  # every algorithm over discrete actions has it
        super()._on_training_start()
