"""Options for Stable-Baselines3 agents, discovered while they train by differentiable diverse density."""

from sb3_options.bank import OptionBank
from sb3_options.diverse_density import DiverseDensity
from sb3_options.dqn import OptionDQN
from sb3_options.expansion import expand_action_space
from sb3_options.macro_q import MacroQ
from sb3_options.option import Option
from sb3_options.replay_buffer import OptionReplayBuffer
from sb3_options.rollout_buffer import OptionDictRolloutBuffer, OptionRolloutBuffer
from sb3_options.value_snapshot import interrupt_options
from sb3_options.wrapper import OptionsWrapper

__all__ = [
    "DiverseDensity",
    "MacroQ",
    "Option",
    "OptionBank",
    "OptionDQN",
    "OptionDictRolloutBuffer",
    "OptionReplayBuffer",
    "OptionRolloutBuffer",
    "OptionsWrapper",
    "expand_action_space",
    "interrupt_options",
]
