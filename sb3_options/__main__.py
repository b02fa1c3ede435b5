"""The console script ``sb3-options``, and ``python -m sb3_options``."""

import io
import sys
from collections.abc import Sequence

from sb3_options.extras import how_to_install


def main(program: str = "sb3-options", default: Sequence[str] = ("--help",)) -> None:
    """Run the command line, with ``default`` arguments if there are none; an error names the ``program``."""
    try:
        from sb3_options import cli
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("sb3_options"):
            raise
        sys.exit(f"{program} needs the package {error.name}: {how_to_install('train', 'contrib')}")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal with another encoding may lack φ
    cli.main(sys.argv[1:] or default)


if __name__ == "__main__":
    main()
