"""Options for Stable-Baselines3 agents, discovered while they train by differentiable diverse density."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_options.checkpoints.demonstrations import load_demonstrations as load_demonstrations
    from sb3_options.checkpoints.demonstrations import save_demonstrations as save_demonstrations
    from sb3_options.density.diverse_density import DiverseDensity as DiverseDensity
    from sb3_options.density.proposed import propose_groups as propose_groups
    from sb3_options.execution.concepts import ConceptsInObservation as ConceptsInObservation
    from sb3_options.execution.concepts import WithoutConcepts as WithoutConcepts
    from sb3_options.execution.demonstrations import record_demonstrations as record_demonstrations
    from sb3_options.execution.options_vec_env import OptionsVecEnv as OptionsVecEnv
    from sb3_options.execution.wrapper import OptionsWrapper as OptionsWrapper
    from sb3_options.experience.recording import logged_trajectory as logged_trajectory
    from sb3_options.learning.dqn import OptionDQN as OptionDQN
    from sb3_options.learning.expansion import expand_action_space as expand_action_space
    from sb3_options.learning.macro_q import MacroQ as MacroQ
    from sb3_options.learning.replay_buffer import OptionReplayBuffer as OptionReplayBuffer
    from sb3_options.learning.rollout_buffer import OptionDictRolloutBuffer as OptionDictRolloutBuffer
    from sb3_options.learning.rollout_buffer import OptionRolloutBuffer as OptionRolloutBuffer
    from sb3_options.learning.saved_model import load_model as load_model
    from sb3_options.learning.saved_model import load_options as load_options
    from sb3_options.options.bank import OptionBank as OptionBank
    from sb3_options.options.option import Option as Option

__version__ = "0.2.0.dev0"

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

__all__ = ["__version__", *_MODULES]


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
