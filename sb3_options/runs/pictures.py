"""Files of pictures that a user names."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg

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
