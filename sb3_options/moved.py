"""Names that modules had before 0.2, for models saved then.

SB3's ``model.zip`` names classes by their module. ``DQN.load`` of a model that was saved with 0.1 therefore asks for
``sb3_options.replay_buffer``; `install` answers with the module's new name. New code uses the new names.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    f"sb3_options.{old}": f"sb3_options.{new}"
    for old, new in {
        "bank": "options.bank",
        "dqn": "learning.dqn",
        "exploration": "execution.exploration",
        "macro_q": "learning.macro_q",
        "observations": "experience.observations",
        "option": "options.option",
        "option_policy": "options.policies",
        "replay_buffer": "learning.replay_buffer",
        "rollout_buffer": "learning.rollout_buffer",
        "wrapper": "execution.wrapper",
    }.items()
}
"""Old name → new name of every module whose classes a saved model may hold."""


class _Alias(Loader):
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return importlib.import_module(MOVED[spec.name])

    def exec_module(self, module: ModuleType) -> None:
        """The module has been executed under its new name."""


class _MovedFinder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, _Alias()) if fullname in MOVED else None


def install() -> None:
    """Let the old names be imported; nothing happens the second time."""
    if not any(isinstance(finder, _MovedFinder) for finder in sys.meta_path):
        sys.meta_path.append(_MovedFinder())
