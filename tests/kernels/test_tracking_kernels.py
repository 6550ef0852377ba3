"""The tracking kernel compiled and as plain Python: the same courses."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from rfpose.feedback.columns import PARAMETERS, constant
from rfpose.feedback.mount import Actuator, Mount, posture
from rfpose.feedback.tracking import TrackingSimulation, _kernels
from rfpose.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]

# a dish and a heliostat by every kind of feedback, for three minutes
COURSES = """
import sys
import numpy as np
from rfpose.feedback.tracking import TrackingSimulation, _kernels
from rfpose.scenario import load_scenario
base = load_scenario(sys.argv[1])
found = {}
for collector, methods in (("heliostat", ("open-loop", "encoder", "radio-both")), ("dish", ("sun-sensor", "radio"))):
    site = base.changed(tracking={
        "first_hour": 9.0, "last_hour": 9.05, "settle_s": 0.0, "collector": collector,
        "radio": {"outages": [{"first_hour": 9.02, "last_hour": 9.035}], "ground": "none", "plate_calibration": "none"},
        "radio_model": {"points_per_day": 8, "learn_interval_s": 20.0},
    })
    simulation = TrackingSimulation(site, methods=methods, count=2, seed=4)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    for name, values in simulation.state().items():
        found[f"{collector}/{name}"] = values
# orders: a defocus, an emergency, mirrors that swing and carry the sun on, or hold it
for between in ("carried-on", "held"):
    site = base.changed(tracking={
        "first_hour": 9.0, "last_hour": 9.05, "settle_s": 0.0, "store_interval_s": 4.0,
        "drive": {"speed_mradps": 200.0},
        "field_control": {"between_messages": between, "emergency_hold_s": 8.0},
        "structure": {"natural_hz": 2.2, "damping": 0.05},
        "radio": {"ground": "none", "plate_calibration": "none"},
        "event": [
            {"hour": 9.008, "what": "defocus", "heliostats": ("H02",)},
            {"hour": 9.016, "what": "emergency"}, {"hour": 9.028, "what": "release"},
        ],
    })
    simulation = TrackingSimulation(site, methods=("open-loop", "radio"), count=2, seed=4)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    modes = simulation.curves("radio").mode
    assert {0, 1, 2, 4, 7, 8} <= set(modes.ravel().tolist()), modes
    for name, values in simulation.state().items():
        if values.dtype.kind in "fib":
            found[f"{between}/{name}"] = values
np.savez(sys.argv[2], **found)
"""


def test_compiled_equals_plain_python(tmp_path):
    results = []
    for jit in ("0", "1"):
        out = tmp_path / f"courses{jit}.npz"
        environment = {**os.environ, "NUMBA_DISABLE_JIT": jit}
        subprocess.run(
            [sys.executable, "-c", COURSES, str(ROOT / "data" / "tracking_100m.toml"), str(out)],
            env=environment, check=True,
        )  # fmt: skip
        results.append(dict(np.load(out)))
    compiled, plain = results
    assert compiled.keys() == plain.keys()
    for name, values in compiled.items():
        if name.endswith(("histogram", "hours")):
            # a rounding may move an error into the next bin
            np.testing.assert_allclose(values.sum(), plain[name].sum(), rtol=1e-6, err_msg=name)
        else:
            np.testing.assert_allclose(values, plain[name], rtol=1e-6, atol=1e-9, err_msg=name)


def test_mirrors_stand_as_their_mounts_say_by_the_names_of_parameters():
    site = load_scenario(ROOT / "data" / "tracking_100m.toml").changed(tracking={
        "first_hour": 9.0, "last_hour": 9.05, "store_interval_s": 16.0, "stored": 3, "wind": {"mean_speed_mps": 0.0},
        "structure": {"natural_hz": 0.0}, "drive": {"backlash_mrad": (0.0, 0.0)}, "field_control": None,
        "mount_errors": {"thermal_sigma_mrad": 3.0, "sag_sigma_mrad": 2.0, "worm_sigma_mrad": 2.0},
    })  # fmt: skip
    simulation = TrackingSimulation(site, methods=("open-loop",), count=3, seed=2)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    field, day, curves = simulation.field, simulation.days[0], simulation.curves("open-loop")
    for row in range(3):
        zero_rad, ratio = (constant(field.constant, name)[row] for name in ("angle_at_zero_rad", "worm_ratio"))
        axes = [
            Actuator(counts_per_unit=48_000.0 / (2.0 * np.pi), angle_at_zero_rad=zero_rad[a], worm_ratio=ratio[a])
            for a in range(2)
        ]
        mount = Mount(
            pivot_enu_m=field.pivot_enu_m[row],
            actuators=(axes[0], axes[1]),
            parameters=dict(zip(PARAMETERS, field.true[row], strict=True)),
        )
        for t, heat in enumerate(day.heat[::16]):
            # the pedestal leans by day
            tilts = {
                f"pedestal_tilt_{way}_rad": mount.parameters[f"pedestal_tilt_{way}_rad"] + lean * heat
                for way, lean in zip(("north", "east"), field.lean_rad[row], strict=True)
            }
            wanted = posture(mount.replace(**tilts), curves.motor_count[t, row]).normal_enu
            np.testing.assert_allclose(curves.normal_enu[t, row], wanted, atol=1e-12)


def test_an_error_falls_into_the_bin_of_its_logarithm():
    rng = np.random.default_rng(0)
    angle = np.concatenate([10.0 ** rng.uniform(-8.0, 1.0, 100_000), [0.0, 1e-6, np.inf, np.nan]])
    bins = np.array([_kernels.bin_of.py_func(each) for each in angle])
    by_logarithm = np.floor(_kernels.BINS_PER_DECADE * np.log10(np.maximum(angle[:-1], 1e-6) / _kernels.LOWEST_RAD))
    np.testing.assert_array_equal(bins[:-1], np.minimum(by_logarithm, _kernels.N_BIN - 1))
    assert bins[-1] == _kernels.N_BIN - 1
