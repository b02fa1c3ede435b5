import math
from collections.abc import Sequence
from typing import Any

import pytest

from sb3_options.options.settings import OptionLearningSettings

COUNTS = ("initiation_steps", "max_duration", "sweeps")


@pytest.mark.parametrize(
    ("names", "values", "message"),
    [
        (COUNTS, (0, -1), "greater than or equal to 1"),
        (("initiation_steps", "max_duration", "sweeps"), (1.5, math.nan), "a valid integer|a finite"),
        (("initiation_radius",), (-0.1, math.nan), "greater than or equal to 0"),
        (("gamma",), (0.0, -1.0), "greater than 0"),
        (("gamma",), (1.01, math.nan), "less than or equal to 1|greater than 0"),
        (("leave_reward",), (0.0, math.nan, math.inf, -math.inf), "a finite number|less than 0"),
        (("policy_input",), ("state", None), "'observation' or 'features'"),
        (("value_function",), ("tree", None), "'auto', 'table' or 'network'"),
        (("grow",), (3, None), "a valid boolean"),
    ],
)
def test_settings_out_of_range(names: Sequence[str], values: Sequence[Any], message: str) -> None:
    for name in names:
        for value in values:
            with pytest.raises(
                ValueError, match=rf"^OptionLearningSettings: {name} should be ({message}).*, got {value!r}$"
            ):
                OptionLearningSettings(**{name: value})
