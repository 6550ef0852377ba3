"""The console script ends its process at once, but not before all is done that was to be done."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import atexit, sys, threading, time
import rfpose.cli

class Left:
    def __del__(self):
        print("taken to pieces")

{before}
left = Left()

def work():
    atexit.register(print, "told at the end")
    threading.Thread(target=lambda: (time.sleep(0.2), print("thread done"))).start()
    print("worked")
    sys.exit({code!r})

rfpose.cli.main = work
rfpose.cli.run()
"""


def ended(code, before=""):
    command = [sys.executable, "-c", PROGRAM.format(code=code, before=before)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.splitlines(), done.stderr


@pytest.mark.parametrize(("code", "number"), [(0, 0), (None, 0), (3, 3)])
def test_threads_and_functions_of_the_end_are_waited_for_and_the_rest_is_not(code, number):
    assert ended(code) == (number, ["worked", "thread done", "told at the end"], "")


def test_who_registered_before_is_called_too():
    """Such as a tool that measures coverage: called last, so Python itself has to come to it."""
    found = ended(3, before="atexit.register(print, 'measured')")
    assert found == (3, ["worked", "thread done", "told at the end", "measured", "taken to pieces"], "")


def test_words_instead_of_a_number_are_python_s_to_print():
    assert ended("no such thing") == (
        1, ["worked", "thread done", "told at the end", "taken to pieces"], "no such thing\n",
    )  # fmt: skip


def test_an_unexpected_error_is_shown():
    code, _, errors = ended(0, before="class sys:\n    exit = int.fail")
    assert code == 1
    assert "AttributeError" in errors


def test_streams_that_were_closed_from_the_start_are_passed_over():
    """As under a service or `>&-`: Python has None in their place."""
    code, _, errors = ended(3, before="sys.stdout = None")
    assert (code, errors) == (3, "")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /dev/full")
def test_what_cannot_be_printed_is_still_an_error():
    command = [sys.executable, "-c", PROGRAM.format(code=0, before="")]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with open("/dev/full", "w") as full:  # what is buffered reaches it when the process ends
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=buffered, check=False)
    assert done.returncode == 120


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /dev/full")
@pytest.mark.parametrize("options", [[], ["--json"], ["--json", "--debug"]])
def test_a_full_disk_behind_standard_output_is_one_line_and_no_traceback(tmp_path, options):
    site = tmp_path / "site.toml"
    main = "import rfpose.cli; rfpose.cli.run()"
    subprocess.run([sys.executable, "-c", main, "init", site], check=True, capture_output=True)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", main, "info", site, *options], stdout=full, stderr=subprocess.PIPE, check=False
        )
    lines = done.stderr.decode().splitlines()
    assert lines[-1] == "rfpose: No space left on device"
    assert len(lines) == 1 or "--debug" in options
    assert done.returncode == 3
