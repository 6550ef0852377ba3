"""How far somebody walks who reads from a recording to its normals; `benchmarks/walk.py` prints the way."""

import runpy
from pathlib import Path

import rfpose as rf

WALK = runpy.run_path(str(Path(__file__).resolve().parents[2] / "benchmarks" / "walk.py"))
RETURNS_FROM_PHASES = 0
RETURNS = 2


def test_files_are_not_entered_again():
    """A number may only fall: a function that leads back into a file belongs where it is used, or is handed down."""
    recording = WALK["small_recording"]()
    rf.process(recording)
    steps = WALK["walked"](recording)
    part = WALK["from_phases"](steps)
    # normals are reached at all
    assert {"multilat/rigid/pose.py", "multilat/integrity/guard.py"} <= {step.file for step in part}
    for way, most in ((part, RETURNS_FROM_PHASES), (steps, RETURNS)):
        again = WALK["returns"](way)
        assert sum(map(len, again.values())) <= most, again
