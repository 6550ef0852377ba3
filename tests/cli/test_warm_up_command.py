"""``rfpose warm-up``: after it, what was compiled is not compiled again."""

import json
import os
import subprocess
import sys

import numpy as np
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.jit import compilations, kernel
from rfpose.pipeline.warm_up import JOBS
from told import undocumented, unseen

SECOND = """
import tempfile
import rfpose as rf
from rfpose.jit import compilations
site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
small = site.changed(heliostat=site.heliostat[:3], radio={"frame_samples": 16000}, simulation={"frame_count": 1})
with tempfile.TemporaryDirectory() as folder:
    rf.simulate(small, seed=3).save(folder + "/r.h5")
    rf.process(folder + "/r.h5", folder + "/p.h5", estimator="correlator")
    rf.evaluate(folder + "/p.h5")
rf.layout_map(small)
print(compilations())
"""


@kernel
def _added(x):
    return x + 1.0


def test_compilations_are_counted():
    _added.py_func.__module__ = "rfpose.here"
    before = compilations()
    _added(2.0)
    assert compilations() == before + 1
    _added(3.0)
    assert compilations() == before + 1
    _added(np.float32(3.0))
    assert compilations() == before + 2


def test_what_is_warm_compiles_nothing(monkeypatch):
    # those that the second process does again, and those before them
    jobs = JOBS[: 1 + [job.__name__ for job in JOBS].index("_layouts")]
    monkeypatch.setattr("rfpose.pipeline.warm_up.JOBS", jobs)
    done = CliRunner().invoke(app, ["warm-up", "--json"])
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    assert not undocumented("warm-up", [told])
    assert not unseen("warm-up", [told])
    later = subprocess.run([sys.executable, "-c", SECOND], capture_output=True, text=True, check=True, env=os.environ)
    assert later.stdout.strip() == "0"
