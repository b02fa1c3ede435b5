"""Training that an interrupt ends between two steps, with everything saved, where it can go on from if that is near.

Python raises `KeyboardInterrupt` wherever the program happens to be, and there are places that lose it: SB3's
``DummyVecEnv.step`` deep-copies an ``OrderedDict``, in which CPython's ``copyreg`` takes any exception for a missing
attribute. A handler that only sets a flag cannot be lost, and leaves no step half done.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from types import FrameType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

TERMINAL = [signal.SIGINT] + ([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])
"""What a terminal sends to all its processes: for Ctrl-C, and when it is closed."""

PATIENCE = 5.0
"""Seconds for which training goes on to where a checkpoint can be written; Docker kills 10 s after SIGTERM."""


class Interrupts:
    """Takes SIGINT, SIGTERM and SIGHUP while its ``with`` block runs, and gives the handlers back afterwards.

    The first signal sets `noted`: training ends where a checkpoint can be written, or after `patience` s. A second
    one raises `KeyboardInterrupt`. Once `saving` is set, a signal changes nothing. SIGINT is taken even where it was
    ignored, as in background processes of a script; SIGHUP is left to ``nohup``. Other threads take no signals. `ended`
    is for whoever ends training: it may also come to its end while an interrupt waits.
    """

    def __init__(self) -> None:
        self.noted = False
        self.saving = False
        self.ended = False
        self.patience = 0.0
        self._number: int = signal.SIGINT
        self._at = -math.inf
        self._before: dict[signal.Signals, Any] = {}

    @property
    def status(self) -> int:
        """Exit status after an interrupt, as in shells: 130 for SIGINT, 143 for SIGTERM."""
        return 128 + self._number

    def due(self, ahead: float = 0.0) -> bool:
        """Whether training is to end now, wherever it is; or whether that is so in ``ahead`` seconds."""
        return self.noted and time.monotonic() + ahead >= self._at + self.patience

    def __enter__(self) -> Interrupts:
        self.saving = False  # of the task before
        if threading.current_thread() is threading.main_thread():
            for number in (*TERMINAL, signal.SIGTERM):
                before = signal.getsignal(number)
                if number == signal.SIGINT or before != signal.SIG_IGN:
                    self._before[number] = before
                    signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.saving:
            _say("What was learned is being saved. A moment, please.")
        elif self.noted:
            raise KeyboardInterrupt
        else:
            self.noted, self._number, self._at = True, number, time.monotonic()
            where = f"where it can go on from, or after {self.patience:.0f} s," if self.patience else "after this step"
            _say(f"Interrupted: training ends {where} and is saved. Once more to end it at once.")


class StopWhenNoted(BaseCallback):
    """Ends training after a step, once an interrupt is due; no rollout whose update takes too long is waited for."""

    remembers_nothing = True

    def __init__(self, interrupts: Interrupts) -> None:
        super().__init__()
        self.interrupts = interrupts
        self._rollout_ended: float | None = None
        self._update = 0.0  # seconds

    def _on_rollout_start(self) -> None:
        if self._rollout_ended is not None:
            self._update = time.monotonic() - self._rollout_ended

    def _on_rollout_end(self) -> None:
        self._rollout_ended = time.monotonic()

    def _on_step(self) -> bool:
        if self.interrupts.due(self._update):
            self.interrupts.ended = True
        return not self.interrupts.ended


def ignore_interrupts() -> None:
    """Let a worker process outlive what its terminal sends, so that its parent can save; the parent ends it."""
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def _say(text: str) -> None:
    """Tell the user, without the buffers of Python: the signal may have come in the middle of a print."""
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, f"\n{text}\n".encode())
