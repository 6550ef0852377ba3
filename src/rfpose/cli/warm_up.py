"""``rfpose warm-up``: compile once, so that no command has to."""

from __future__ import annotations

import click

from rfpose.cli._support import common_options, emit_json, examples, progress, say, wants_json

__all__ = ["command"]


@click.command(name="warm-up", epilog=examples("rfpose warm-up", "rfpose warm-up --json"))
@common_options
def command() -> None:
    """Compile all kernels once, so that no later command has to; it takes a few minutes, after installing.

    Each of rfpose's jobs is done on a very small field. What is compiled is kept in the package's directory or,
    where that cannot be written, in the user's cache; NUMBA_CACHE_DIR names another place.
    """
    with progress("Compiling") as shown:
        from rfpose.pipeline.warm_up import warm_up

        done = warm_up(on_progress=shown)
    if wants_json():
        emit_json(done.as_dict())
        return
    text = f"compiled {done.compiled} kernels" if done.compiled else "all kernels were compiled before"
    say(f"{text}, in {done.seconds:.0f} s")
