import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_options.runs.under_way import LOCK, held

HOLDS = """
import sys, time
from pathlib import Path
from sb3_options.runs.under_way import held
with held(Path(sys.argv[1])):
    print("holds it", flush=True)
    time.sleep(600)
"""


def test_another_process_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"holds it\n"
            with pytest.raises(ValueError, match="is being trained by another process"), held(tmp_path):
                pytest.fail("two hold it")
        finally:
            os.kill(other.pid, signal.SIGKILL)
    assert (tmp_path / LOCK).is_file()  # which keeps nobody
    with held(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


def test_nor_do_two_in_one_process_hold_it(tmp_path: Path) -> None:
    with held(tmp_path):
        with pytest.raises(ValueError, match="is being trained by another process"), held(tmp_path):
            pytest.fail("two hold it")
        assert (tmp_path / LOCK).is_file()


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "users").write_text("own")
    (tmp_path / LOCK).symlink_to(tmp_path / "users")
    with pytest.raises(OSError, match="symbolic links"), held(tmp_path):
        pytest.fail("it was followed")
    assert (tmp_path / "users").read_text() == "own"


def test_a_folder_that_is_removed_meanwhile_is_no_error(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with held(folder):
        (folder / LOCK).unlink()
        folder.rmdir()
