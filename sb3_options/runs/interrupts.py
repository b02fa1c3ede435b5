"""Training that an interrupt ends between two steps, with everything saved.

Python raises `KeyboardInterrupt` wherever the program happens to be, and there are places that lose it: SB3's
``DummyVecEnv.step`` deep-copies an ``OrderedDict``, in which CPython's ``copyreg`` takes any exception for a missing
attribute. A handler that only sets a flag cannot be lost, and leaves no step half done.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

TERMINAL = [signal.SIGINT] + ([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])
"""What a terminal sends to all its processes: for Ctrl-C, and when it is closed."""


class Interrupts:
    """Takes SIGINT, SIGTERM and SIGHUP while its ``with`` block runs, and gives the handlers back afterwards.

    The first signal sets `noted`, for `StopWhenNoted` to end training after the step that is under way, in the middle
    of an evaluation too. A second one raises `KeyboardInterrupt`, for a user who does not want to wait. Once `saving`
    is set, a signal changes nothing. Each time the user is told.

    SIGINT is taken even where it was ignored, as it is in the background processes of a shell script; SIGHUP is left to
    ``nohup``. Outside the main thread, where Python allows no handlers, nothing happens.
    """

    def __init__(self) -> None:
        self.noted = False
        self.saving = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
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
            self.noted = True
            _say("Interrupted: training ends after this step and is saved. Once more to end it at once.")


class StopWhenNoted(BaseCallback):
    """Ends training after the step in which an interrupt came.

    Args:
        interrupts: Notes it.
    """

    remembers_nothing = True

    def __init__(self, interrupts: Interrupts) -> None:
        super().__init__()
        self.interrupts = interrupts

    def _on_step(self) -> bool:
        return not self.interrupts.noted


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Have SIGINT, SIGTERM and SIGHUP raise `KeyboardInterrupt`, for work that may end anywhere but has to clean up.

    They are taken as by `Interrupts`: SIGINT even where it was ignored, and nothing outside the main thread.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in (*TERMINAL, signal.SIGTERM)}
    taken = {number: old for number, old in before.items() if number == signal.SIGINT or old != signal.SIG_IGN}
    for number in taken:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, old in taken.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


def ignore_interrupts() -> None:
    """Let a worker process outlive what its terminal sends, so that its parent can save; the parent ends it."""
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def _say(text: str) -> None:
    """Tell the user, without the buffers of Python: the signal may have come in the middle of a print."""
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, f"\n{text}\n".encode())
