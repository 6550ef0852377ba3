"""
Calibrating a heliostat from PAINT records
==========================================

PAINT is the open data base of the heliostats of Jülich: motor positions, sun and focal spot of thousands of
calibrations. From such records comes a kinematic model of each heliostat, and how far to trust it.

**The records of this page are synthetic**: made in PAINT's layout from mounts whose errors are known, by
what ``rfpose sample paint`` makes them with. Real ones are fitted in the same way, ``rf.calibrate("paint/")``.
"""

# %%
import tempfile
from pathlib import Path

import rfpose as rf
from rfpose.pipeline.samples.paint import ERRORS, write_paint

folder = Path(tempfile.mkdtemp()) / "paint"
write_paint(folder, {"AA23": (-20.0, 60.0, 0.0), "AB41": (35.0, 90.0, 0.0)}, n_record=40)
sorted(path.name for path in folder.iterdir())

# %%
# Which parameters to fit is chosen for each heliostat: as many as its records carry. Held out: 40 % of the records, ten
# times at random, predicted from the others.
found = rf.calibrate(folder)
found

# %%
# Each record's error after the fit; grey is what was held out.
figure = found.plot()

# %%
# As built, before and after: how far the mount's normals lie from those that sun and focal spot ask for.
import numpy as np

from rfpose.feedback.paint import read_heliostat
from rfpose.feedback.prediction import normal_errors_rad

report = found[0]
made = report.calibration.measurements
planned = normal_errors_rad(read_heliostat(folder, report.id).mount, made)
fitted = report.calibration.error_rad
f"{report.id}: median {1e3 * np.median(planned):.2f} mrad as built, {1e3 * np.median(fitted):.2f} fitted"

# %%
# The errors that the records were made with, and what was found of them. A zero of axis 1 and a canting to the right
# turn the mirror by nearly the same: the records carry only how the two act together, 4 − 5 = −1 mrad, and a model with
# one of them predicts better than one with both.
for name, true in ERRORS.items():
    estimate = report.calibration.estimate.get(name)
    told = "not fitted" if estimate is None else f"{1e3 * estimate:+.2f} ± {1e3 * report.calibration.sigma[name]:.2f}"
    print(f"{name}: {1e3 * true:+.0f} mrad, {told}")

# %%
# Why these parameters:
report.as_dict()["choice"]["reason"]

# %%
# The models go into a file, and from there into commands: motor positions with every known error undone.
from rfpose.pipeline.aim import plan_commands

models = folder.with_name("models.json")
found.save(models)
plans = plan_commands(models, target_enu_m=(0.0, 0.0, 36.0), start="2026-06-21T10:00Z", hours=2.0, step_s=1800.0)
plans[0].as_dict()["commands"][:2]
