"""The sun: the algorithm's published example, conventions, times."""

from datetime import datetime

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.sun import Location, sun_position, unix_seconds

GOLDEN = Location(
    latitude_rad=np.deg2rad(39.742476),
    longitude_rad=np.deg2rad(-105.1786),
    altitude_m=1830.14,
    pressure_pa=82000.0,
    temperature_degc=11.0,
)


def test_published_example():
    # Reda and Andreas, NREL/TP-560-34302, Table A5.1: zenith 50.11162°, azimuth 194.34024°, for ΔT = 67 s;
    # 2.2 s more of ΔT move the sun by 0.5 µrad along its path
    sun = sun_position(unix_seconds(["2003-10-17T12:30:30-07:00"]), GOLDEN)
    assert np.pi / 2 - sun.elevation_rad[0] == pytest.approx(np.deg2rad(50.11162), abs=1e-6)
    assert sun.azimuth_rad[0] == pytest.approx(np.deg2rad(194.34024), abs=1e-6)


def test_refraction_lifts_the_sun_at_the_horizon():
    dark = Location(latitude_rad=GOLDEN.latitude_rad, longitude_rad=GOLDEN.longitude_rad, pressure_pa=0.0)
    air = Location(latitude_rad=GOLDEN.latitude_rad, longitude_rad=GOLDEN.longitude_rad)
    t = unix_seconds(["2003-10-17T00:20:00Z"]) + np.arange(0.0, 1500.0, 60.0)
    low = sun_position(t, dark).elevation_rad
    i = int(np.argmin(np.abs(low)))
    lift = sun_position(t, air).elevation_rad[i] - low[i]
    assert 6e-3 < lift < 1.1e-2  # about half a degree


def test_direction_has_the_frame_of_the_project():
    # morning: east; noon, north of the tropics: south; afternoon: west
    sun = sun_position(unix_seconds([f"2024-03-20T{h}:00:00-07:00" for h in ("08", "12", "16")]), GOLDEN)
    assert sun.direction_enu[0, 0] > 0.5 > -0.5 > sun.direction_enu[2, 0]
    assert sun.direction_enu[1, 1] < -0.5
    np.testing.assert_allclose(np.linalg.norm(sun.direction_enu, axis=1), 1.0)


def test_an_unknown_time_stays_unknown():
    sun = sun_position([np.nan, 1.7e9], GOLDEN)
    assert np.isnan(sun.elevation_rad[0])
    assert np.isfinite(sun.elevation_rad[1])


def test_times_in_their_forms():
    text = unix_seconds(["2024-02-01T10:09:37Z"])
    assert text[0] == unix_seconds(np.array(["2024-02-01T10:09:37"], "datetime64[s]"))[0] == 1706782177.0
    with pytest.raises(InvalidInputError, match="time zone"):
        unix_seconds([datetime(2024, 2, 1)])
    with pytest.raises(InvalidInputError, match="ISO 8601"):
        unix_seconds(["yesterday"])


def test_degrees_are_refused():
    with pytest.raises(InvalidInputError, match="deg2rad"):
        Location(latitude_rad=50.9, longitude_rad=0.1)
    with pytest.raises(InvalidInputError, match="deg2rad"):
        Location(latitude_rad=0.9, longitude_rad=-105.0)
