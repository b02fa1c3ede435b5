"""Options for Stable-Baselines3 agents, discovered while they train by differentiable diverse density."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_options.checkpoints.demonstrations import load_demonstrations, save_demonstrations
    from sb3_options.density.diverse_density import DiverseDensity
    from sb3_options.density.proposed import propose_groups
    from sb3_options.execution.concepts import ConceptsInObservation, WithoutConcepts
    from sb3_options.execution.demonstrations import record_demonstrations
    from sb3_options.execution.options_vec_env import OptionsVecEnv
    from sb3_options.execution.wrapper import OptionsWrapper
    from sb3_options.experience.recording import logged_trajectory
    from sb3_options.learning.dqn import OptionDQN
    from sb3_options.learning.expansion import expand_action_space
    from sb3_options.learning.macro_q import MacroQ
    from sb3_options.learning.replay_buffer import OptionReplayBuffer
    from sb3_options.learning.rollout_buffer import OptionDictRolloutBuffer, OptionRolloutBuffer
    from sb3_options.learning.saved_model import load_model, load_options
    from sb3_options.options.bank import OptionBank
    from sb3_options.options.option import Option

__version__ = "0.2.0.dev0"

__all__ = [
    "ConceptsInObservation",
    "DiverseDensity",
    "MacroQ",
    "Option",
    "OptionBank",
    "OptionDQN",
    "OptionDictRolloutBuffer",
    "OptionReplayBuffer",
    "OptionRolloutBuffer",
    "OptionsVecEnv",
    "OptionsWrapper",
    "WithoutConcepts",
    "__version__",
    "expand_action_space",
    "load_demonstrations",
    "load_model",
    "load_options",
    "logged_trajectory",
    "propose_groups",
    "record_demonstrations",
    "save_demonstrations",
]

_MODULES = {
    "load_demonstrations": "sb3_options.checkpoints.demonstrations",
    "save_demonstrations": "sb3_options.checkpoints.demonstrations",
    "DiverseDensity": "sb3_options.density.diverse_density",
    "propose_groups": "sb3_options.density.proposed",
    "ConceptsInObservation": "sb3_options.execution.concepts",
    "WithoutConcepts": "sb3_options.execution.concepts",
    "record_demonstrations": "sb3_options.execution.demonstrations",
    "OptionsVecEnv": "sb3_options.execution.options_vec_env",
    "OptionsWrapper": "sb3_options.execution.wrapper",
    "logged_trajectory": "sb3_options.experience.recording",
    "OptionDQN": "sb3_options.learning.dqn",
    "expand_action_space": "sb3_options.learning.expansion",
    "MacroQ": "sb3_options.learning.macro_q",
    "OptionReplayBuffer": "sb3_options.learning.replay_buffer",
    "OptionDictRolloutBuffer": "sb3_options.learning.rollout_buffer",
    "OptionRolloutBuffer": "sb3_options.learning.rollout_buffer",
    "load_model": "sb3_options.learning.saved_model",
    "load_options": "sb3_options.learning.saved_model",
    "OptionBank": "sb3_options.options.bank",
    "Option": "sb3_options.options.option",
}
"""The module of each public name, imported when the name is first used: torch and SB3 take a second."""


def __getattr__(name: str) -> Any:
    """Import a public name."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return sorted(__all__)
