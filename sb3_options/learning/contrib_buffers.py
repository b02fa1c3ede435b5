"""The rollout buffers of sb3-contrib with advantages over options (extra ``contrib``)."""

from __future__ import annotations

from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer, MaskableRolloutBuffer
from sb3_contrib.common.recurrent.buffers import RecurrentDictRolloutBuffer, RecurrentRolloutBuffer

from sb3_options.learning.rollout_buffer import SMDPAdvantages


class OptionMaskableRolloutBuffer(SMDPAdvantages, MaskableRolloutBuffer):
    """`OptionRolloutBuffer` for MaskablePPO."""


class OptionMaskableDictRolloutBuffer(SMDPAdvantages, MaskableDictRolloutBuffer):
    """`OptionRolloutBuffer` for MaskablePPO and ``Dict`` observations."""


class OptionRecurrentRolloutBuffer(SMDPAdvantages, RecurrentRolloutBuffer):
    """`OptionRolloutBuffer` for RecurrentPPO, whose LSTM sees the observations at decisions only."""


class OptionRecurrentDictRolloutBuffer(SMDPAdvantages, RecurrentDictRolloutBuffer):
    """`OptionRolloutBuffer` for RecurrentPPO and ``Dict`` observations."""
