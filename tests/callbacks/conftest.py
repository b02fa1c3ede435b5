import os

import pytest

from sb3_options.checkpoints import file as checkpoint_file


@pytest.fixture
def keep_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint_file, "KEPT", 10**6)
    monkeypatch.setattr(os, "fsync", lambda _: None)  # no power fails here
