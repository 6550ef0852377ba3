"""Electronic phases from calibration receivers (seed 003 §3.6)."""

import numpy as np
import pytest

from rfpose.dsp.calibration import CalibrationStatus, average_phases, interpolate_phase, wrap
from rfpose.errors import InvalidInputError

TRANSMITTER = np.random.default_rng(0).uniform(-100, 100, (6, 3))
WAVELENGTH = np.array([400.0, 50.0])


def relative(phase):
    return wrap(phase - phase[..., :1, :])


def measured(place, electronic, clock):
    """Tone phases at surveyed places: Φ − 2πd/λ + clock."""
    range_m = np.linalg.norm(place[:, None] - TRANSMITTER, axis=-1)
    return wrap(electronic[None, None] - 2 * np.pi * range_m[None, :, :, None] / WAVELENGTH + clock)


def electronic_phase(phase, sigma, **settings):
    average = average_phases(phase, sigma, **settings)
    return average.phase_rad, average.sigma_rad


def test_electronic_phase_is_recovered_up_to_the_clock():
    rng = np.random.default_rng(1)
    place = rng.uniform(-50, 50, (3, 3))
    electronic = rng.uniform(-np.pi, np.pi, (6, 2))
    phase = measured(place, electronic, rng.uniform(-3, 3, (4, 3, 1, 2)))
    found, sigma = electronic_phase(
        phase,
        np.full(phase.shape, 0.01),
        calibration_enu_m=place,
        transmitter_enu_m=TRANSMITTER,
        wavelength_m=WAVELENGTH,
    )
    np.testing.assert_allclose(wrap(relative(found) - relative(electronic)), 0.0, atol=1e-9)
    np.testing.assert_allclose(sigma, 0.01 / np.sqrt(3))
    assert np.all(found > -np.pi)
    assert np.all(found <= np.pi)


def test_scatter_is_the_reported_sigma():
    rng = np.random.default_rng(2)
    place = rng.uniform(-50, 50, (2, 3))
    electronic = rng.uniform(-np.pi, np.pi, (6, 2))
    sigma = np.broadcast_to(np.array([0.01, 0.03])[None, :, None, None], (4000, 2, 6, 2))
    phase = measured(place, electronic, rng.uniform(-3, 3, (4000, 2, 1, 2))) + sigma * rng.standard_normal(sigma.shape)
    found, reported = electronic_phase(
        phase, sigma, calibration_enu_m=place, transmitter_enu_m=TRANSMITTER, wavelength_m=WAVELENGTH
    )
    error = wrap(relative(found) - relative(electronic))[:, 1:]
    expected = np.sqrt(reported[0, 1, 0] ** 2 + reported[0, 0, 0] ** 2)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(expected, rel=0.03)


def test_a_transmitter_seen_by_one_receiver_only_joins_in():
    rng = np.random.default_rng(3)
    place = rng.uniform(-50, 50, (2, 3))
    electronic = rng.uniform(-np.pi, np.pi, (6, 2))
    phase = measured(place, electronic, rng.uniform(-3, 3, (1, 2, 1, 2)))
    phase[:, 0, 4] = np.nan
    phase[:, :, 5] = np.nan
    found, sigma = electronic_phase(
        phase,
        np.full(phase.shape, 0.01),
        calibration_enu_m=place,
        transmitter_enu_m=TRANSMITTER,
        wavelength_m=WAVELENGTH,
    )
    np.testing.assert_allclose(wrap(relative(found) - relative(electronic))[:, :5], 0.0, atol=1e-9)
    assert sigma[0, 4, 0] == pytest.approx(0.01)
    assert np.isnan(found[:, 5]).all()


def shifted(place, electronic, clock, shift):
    """Phases that lag by reflections, as `average_phases` takes them."""
    phase = wrap(measured(place, electronic, clock) - shift)
    sigma = np.broadcast_to([0.01, 0.02, 0.015, 0.01], (len(phase), 6, 2, 4)).transpose(0, 3, 1, 2)
    return average_phases(phase, sigma, calibration_enu_m=place, transmitter_enu_m=TRANSMITTER, wavelength_m=WAVELENGTH)


def test_an_average_follows_its_receivers_however_far():
    rng = np.random.default_rng(7)
    place = rng.uniform(-50, 50, (4, 3))
    electronic = rng.uniform(-np.pi, np.pi, (6, 2))
    shift = rng.uniform(-1.4, 1.4, (4, 6, 2))
    average = shifted(place, electronic, rng.uniform(-3, 3, (5, 4, 1, 2)), shift)
    assert np.abs(wrap(relative(average.phase_rad) - relative(electronic))).max() > 0.3
    change = average.change_rad(np.stack([shift, shift / 2.0], axis=-1), np.array([3, 0]))
    # with each receiver's own shift taken off nothing of it is left
    corrected = average.phase_rad[[3, 0]] + change[..., 0]
    np.testing.assert_allclose(wrap(relative(corrected) - relative(electronic)), 0.0, atol=1e-9)
    # derivatives are those of the average of small changes
    small = average.change_rad(1e-6 * shift[..., None], np.array([3, 0]))[..., 0]
    np.testing.assert_allclose(relative(change[..., 1]), relative(small) / 2e-6, atol=1e-6)


def test_a_mean_of_phases_is_no_phase_of_a_mean():
    place = np.zeros((2, 3))
    shift = np.zeros((2, 6, 2))
    shift[:, 0, 0] = 0.0, 1.2
    shift[:, 1, 0] = 0.0, -1.2
    phase = wrap(measured(place, np.zeros((6, 2)), 0.0) + shift)
    sigma = np.broadcast_to(np.array([0.01, 0.02])[:, None, None], (1, 2, 6, 2))
    found, _ = electronic_phase(
        phase, sigma, calibration_enu_m=place, transmitter_enu_m=TRANSMITTER, wavelength_m=WAVELENGTH
    )
    # a fifth of the weight is the second one's; as phasors the two would make 0.196 of it
    np.testing.assert_allclose(wrap(found[0, 0, 0] - found[0, 2, 0]), 0.24, atol=1e-9)


def test_receivers_join_in_whatever_their_order():
    rng = np.random.default_rng(8)
    place = rng.uniform(-50, 50, (3, 3))
    electronic = rng.uniform(-np.pi, np.pi, (6, 2))
    phase = measured(place, electronic, rng.uniform(-3, 3, (1, 3, 1, 2)))
    # the first two share no transmitter; the last one joins them
    phase[:, 0, 2:], phase[:, 1, :3], phase[:, 2, [0, 5]] = np.nan, np.nan, np.nan
    settings = {"calibration_enu_m": place, "transmitter_enu_m": TRANSMITTER, "wavelength_m": WAVELENGTH}
    found, _ = electronic_phase(phase, np.full(phase.shape, 0.01), **settings)
    np.testing.assert_allclose(wrap(relative(found) - relative(electronic)), 0.0, atol=1e-9)
    phase[:, 2] = np.nan
    found, sigma = electronic_phase(phase, np.full(phase.shape, 0.01), **settings)
    np.testing.assert_array_equal(np.isfinite(found[0, :, 0]), [False, False, False, True, True, True])
    np.testing.assert_array_equal(np.isfinite(sigma), np.isfinite(found))


def test_survey_error_enters_the_sigma():
    phase = np.zeros((1, 1, 6, 2))
    _, sigma = electronic_phase(
        phase,
        np.full(phase.shape, 1e-6),
        calibration_enu_m=np.zeros((1, 3)),
        transmitter_enu_m=TRANSMITTER,
        wavelength_m=WAVELENGTH,
        survey_sigma_m=0.01,
    )
    np.testing.assert_allclose(sigma[0, 0], 2 * np.pi * 0.01 / WAVELENGTH, rtol=1e-3)


def test_missing_frames_are_filled_and_say_so():
    rng = np.random.default_rng(4)
    time = np.arange(40) * 10.0
    walk = np.cumsum(0.02 * rng.standard_normal((40, 6, 2)), axis=0)
    clock = rng.uniform(-3, 3, (40, 1, 2))
    phase = wrap(walk + clock)
    phase[10:13, 2] = np.nan
    phase[38:, 3] = np.nan
    phase[:, 5] = np.nan
    found, sigma, drift, status = interpolate_phase(phase, np.full(phase.shape, 1e-4), time)
    # the common turn of each frame takes 1/5 of the variance of the five transmitters' steps
    assert drift == pytest.approx(np.full(2, 0.02 * np.sqrt(0.8) / np.sqrt(10.0)), rel=0.2)
    assert np.all(status[10:13, 2] == CalibrationStatus.INTERPOLATED)
    assert np.all(status[38:, 3] == CalibrationStatus.EXTRAPOLATED)
    assert np.all(status[:, 5] == CalibrationStatus.MISSING)
    assert np.isnan(found[:, 5]).all()
    error = wrap(found - wrap(walk + clock))
    error = wrap(error - error[:, :1])
    assert np.all(np.abs(error[11, 2]) < 5 * sigma[11, 2] + 0.02 * np.sqrt(2))
    assert np.all(sigma[11, 2] > 0.01)
    assert np.all(sigma[39, 3] > sigma[38, 3])


def test_one_frame_cannot_be_extrapolated_from():
    phase = np.zeros((2, 6, 2))
    phase[1, 3] = np.nan
    found, _, _, status = interpolate_phase(phase[[1, 1]], np.full(phase.shape, 1e-3), np.array([0.0, 1.0]))
    assert np.all(status[:, 3] == CalibrationStatus.MISSING)
    assert np.isnan(found[:, 3]).all()


def test_wrong_shapes_are_refused():
    with pytest.raises(InvalidInputError, match="sigma_rad"):
        electronic_phase(
            np.zeros((1, 1, 6, 2)),
            np.zeros((1, 1, 6, 1)),
            calibration_enu_m=np.zeros((1, 3)),
            transmitter_enu_m=TRANSMITTER,
            wavelength_m=WAVELENGTH,
        )


def test_sigma_is_noise_and_survey():
    rng = np.random.default_rng(5)
    survey_m = np.array([0.0, 0.002, 0.01])
    sigma = rng.uniform(1e-5, 1e-3, (2, 3, 6, 2))
    found = average_phases(
        np.zeros(sigma.shape),
        sigma,
        calibration_enu_m=np.zeros((3, 3)),
        transmitter_enu_m=TRANSMITTER,
        wavelength_m=WAVELENGTH,
        survey_sigma_m=survey_m,
    )
    share = found.weight / found.weight.sum(axis=1, keepdims=True)
    survey = 2.0 * np.pi / WAVELENGTH * survey_m[:, None]
    np.testing.assert_allclose(found.noise_rad, np.sqrt((share**2 * sigma**2).sum(axis=1)), rtol=1e-9)
    both = found.noise_rad**2 + (share**2 * survey[:, None] ** 2).sum(axis=1)
    np.testing.assert_allclose(found.sigma_rad, np.sqrt(both), rtol=1e-9)
