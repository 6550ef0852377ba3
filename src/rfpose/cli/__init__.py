"""The command line: one module a sub-command, loaded when it is called.

Nothing here may import numpy, scipy, numba or h5py at module level: ``rfpose --help`` answers at once, and so does a
refusal. What a command does lives in `rfpose.pipeline`; the modules here read options and print.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys

from rfpose import interruption

__all__ = ["main", "run"]


def run() -> None:
    """Entry point of the ``rfpose`` command: `main`, after which the process ends without taking itself to pieces.

    Python would first give back, one by one, all that libraries made, which takes long and serves nobody. What is to be
    done at the end is done: files are closed, threads waited for, functions of `atexit` called. Only where another
    registered one of those before (a profiler, say), Python ends as it always does.
    """
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")  # its threads sleep when idle; else they spin for long
    ended: list[int] = []

    def leave() -> None:
        with contextlib.suppress(OSError, ValueError):  # what a closed pipe did not take is left to Python
            for stream in filter(None, (sys.stdout, sys.stderr)):  # one that was closed from the start is None
                stream.flush()
            if ended:
                os._exit(ended[0])

    if getattr(atexit, "_ncallbacks", lambda: 1)() == 0:  # what is registered first is called last
        atexit.register(leave)
    try:
        main()
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            ended.append(error.code or 0)
        raise


def main() -> None:
    """Run the command that ``sys.argv`` names, and exit."""
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
