"""Files of demonstrations."""

import os
from collections.abc import Iterable
from pathlib import Path

from sb3_options.atomic import atomic_write
from sb3_options.checkpoints.tree import decode, encode
from sb3_options.experience.trajectories import Trajectory
from sb3_options.options.sealed import errors_of, sealed, unsealed

FORMAT = "sb3-options demonstrations 1"

MANY = 50
"""From so many successful demonstrations on, training refines a cloned policy. Chosen by hand between 20, from which it
must still explore, and 100, from which small updates were better (docs/studies/demonstrations.md)."""


def save_demonstrations(path: str | os.PathLike[str], trajectories: Iterable[Trajectory]) -> None:
    """Write trajectories to a safetensors file, atomically: arrays and JSON, no code."""
    content, arrays = encode(list(trajectories))
    with atomic_write(path) as temporary:
        temporary.write_bytes(sealed(FORMAT, {"trajectories": content}, arrays))


def load_demonstrations(path: str | os.PathLike[str]) -> list[Trajectory]:
    """Read a file from `save_demonstrations`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds no demonstrations, or is damaged.
    """
    content = Path(path).read_bytes()
    with errors_of(os.fspath(path), "holds no demonstrations, or it is damaged"):
        parts, arrays = unsealed(content, FORMAT)
        trajectories: list[Trajectory] = decode(parts["trajectories"], arrays)
        if not all(isinstance(each, Trajectory) for each in trajectories):
            raise ValueError("it holds something other than trajectories")
    return trajectories
