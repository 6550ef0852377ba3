"""Measured irradiance: read, laid on the days, refused by line."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback.tracking.sky import under_sky
from rfpose.feedback.tracking.timeline import days
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[3] / "data" / "tracking_100m.toml"


def scenario(record):
    hours = {"first_hour": 9.0, "last_hour": 11.0}
    return load_scenario(DATA).changed(tracking={"sky": "record", "beam_record": str(record), **hours})


def record(tmp_path, rows, unit="w_per_m2"):
    path = tmp_path / "dni.csv"
    path.write_text("\n".join([f"unix_s,dni_{unit}", *(f"{t},{v}" for t, v in rows)]))
    return path


@pytest.fixture
def span():
    day = days(scenario("none"))[0]
    return day.unix_s[0], day.unix_s[-1]


def test_irradiance_is_as_measured_and_dark_in_long_gaps(tmp_path, span):
    first, last = span
    # a sample each ten minutes, then none known for an hour and a half
    times = np.arange(first - 600.0, last + 1200.0, 600.0)
    gap = (times > first + 1200.0) & (times < first + 6600.0)
    rows = [(t, "" if dark else 0.1 * (t - first) / 60.0 + 500.0) for t, dark in zip(times, gap, strict=True)]
    day = under_sky(scenario(record(tmp_path, rows)), days(scenario("none")), seed=0)[0]
    ramp = 0.1 * (day.unix_s - first) / 60.0 + 500.0
    known = day.power_w_per_m2 > 0.0
    np.testing.assert_allclose(day.power_w_per_m2[known], ramp[known], rtol=1e-9)
    assert np.mean(known) == pytest.approx(1.0 - 6000.0 / (last - first), abs=0.17)
    assert not known[len(known) // 2]
    kilo = [(t, "" if v == "" else v / 1e3) for t, v in rows]
    again = under_sky(scenario(record(tmp_path, kilo, "kw_per_m2")), days(scenario("none")), seed=0)[0]
    np.testing.assert_allclose(again.power_w_per_m2, day.power_w_per_m2)


def test_bad_irradiance_is_refused_by_line(tmp_path, span):
    first, last = span
    short = record(tmp_path, [(first - 60.0, 800.0), (last - 600.0, 800.0)])
    with pytest.raises(ScenarioError, match="`beam_record` does not reach over 2026-03-20"):
        under_sky(scenario(short), days(scenario("none")), seed=0)
    for rows, complaint in (
        ([(first, 0.8), (first - 1.0, 0.8)], "line 3: time must go on"),
        ([(first, 800.0), (first + 1.0, 8000.0)], r"line 3: `dni_w_per_m2` 8000.0 is 8000 W/m², beyond the sun"),
        ([(first, -1.0), (first + 1.0, 0.0)], "line 2: `dni_w_per_m2` must not be negative"),
    ):
        with pytest.raises(InvalidInputError, match=complaint):
            under_sky(scenario(record(tmp_path, rows)), days(scenario("none")), seed=0)


def test_a_record_and_its_sky_belong_together():
    for change in ({"sky": "record"}, {"beam_record": "dni.csv"}):
        with pytest.raises(ValueError, match="belong together"):
            load_scenario(DATA).changed(tracking=change)
