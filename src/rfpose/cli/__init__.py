"""The command line: one module a sub-command, loaded when it is called.

Nothing here may import numpy, scipy, numba or h5py at module level: ``rfpose --help`` answers at once, and so does a
refusal. What a command does lives in `rfpose.pipeline`; the modules here read options and print.
"""

from __future__ import annotations

import sys

from rfpose import interruption

__all__ = ["main"]


def main() -> None:
    """Entry point of the ``rfpose`` command."""
    with interruption.heard():
        code: str | int | None = 0
        try:
            from rfpose.cli._app import app

            app(prog_name="rfpose")
        except KeyboardInterrupt:  # before the command, which answers to its own
            code = 130
        except SystemExit as ended:
            code = ended.code
        interruption.ignore_for_good()
    sys.exit(code)
