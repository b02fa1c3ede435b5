"""Files of pictures that a user names."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sb3_options.atomic import atomic_write
from sb3_options.runs.users_code import named_in_errors

DPI = 110


def format_of(picture: Path) -> str:
    """The format that a picture's name asks for.

    Raises:
        ValueError: It is none that can be drawn.
    """
    known = FigureCanvasAgg.get_supported_filetypes()
    name = picture.suffix.removeprefix(".").lower()
    if name not in known:
        raise ValueError(f"--out {picture}: choose a name that ends with .png, .pdf or .svg.")
    return name


def save_picture(figure: Figure, picture: Path) -> None:
    """Write the picture that ``--out`` names, in the format that its name asks for.

    Raises:
        ValueError: The format is none that can be drawn.
        OSError: It cannot be written.
    """
    with named_in_errors("--out", picture, "cannot be written"), atomic_write(picture) as temporary:
        figure.savefig(temporary, dpi=DPI, format=format_of(picture))
