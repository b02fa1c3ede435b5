"""Options for Stable-Baselines3 agents, discovered while they train by differentiable diverse density."""

from sb3_options.density.diverse_density import DiverseDensity
from sb3_options.execution.concepts import ConceptsInObservation, WithoutConcepts
from sb3_options.execution.wrapper import OptionsWrapper
from sb3_options.learning.dqn import OptionDQN
from sb3_options.learning.expansion import expand_action_space
from sb3_options.learning.macro_q import MacroQ
from sb3_options.learning.replay_buffer import OptionReplayBuffer
from sb3_options.learning.rollout_buffer import OptionDictRolloutBuffer, OptionRolloutBuffer
from sb3_options.learning.saved_model import load_model, load_options
from sb3_options.learning.value_snapshot import interrupt_options
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
    "OptionsWrapper",
    "WithoutConcepts",
    "__version__",
    "expand_action_space",
    "interrupt_options",
    "load_model",
    "load_options",
]
