"""The command line: one module a sub-command, loaded when it is called.

Nothing here may import numpy, scipy, numba or h5py at module level: ``rfpose --help`` answers at once. What a
command does lives in `rfpose.pipeline`; the modules here read options and print.
"""

from __future__ import annotations

from rfpose.cli._app import app

__all__ = ["main"]


def main() -> None:
    """Entry point of the ``rfpose`` command."""
    app(prog_name="rfpose")
