"""Tone phases to range differences: references, whole wavelengths, several tones, what is refused."""

import numpy as np
import pytest

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat import RangeStatus, check_unambiguous, range_differences
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
WAVELENGTH = np.array([400.0, 40.0])


def phases(rng, receiver, wavelength, sigma_rad=0.0, electronic=0.0):
    """(receiver, transmitter, tone) phases, each receiver with a clock phase of its own a tone, on any branch."""
    d = np.linalg.norm(np.atleast_2d(receiver)[:, None] - TRANSMITTER, axis=-1)[..., None]
    phase = electronic - 2 * np.pi * d / wavelength + rng.uniform(-9, 9, (len(d), 1, len(wavelength)))
    return np.angle(np.exp(1j * (phase + sigma_rad * rng.standard_normal(phase.shape))))


def anywhere(rng, n):
    """Receivers in and far outside the field: no integer may depend on where they are."""
    return rng.uniform(-300, 300, (n, 3)) * [1, 1, 0.1]


def to_first(ranges):
    return ranges - ranges[..., :1]


@pytest.mark.parametrize("wavelength", [[400.0], [400.0, 40.0], [40.0, 400.0, 6.0], [210.0]])
def test_exact_phases_give_exact_differences_wherever_the_receiver_is(wavelength):
    rng = np.random.default_rng(1)
    receiver = anywhere(rng, 300)
    wavelength = np.array(wavelength)
    electronic = rng.uniform(-3, 3, (10, len(wavelength)))
    phase = phases(rng, receiver, wavelength, electronic=electronic)
    result = range_differences(phase, np.full(phase.shape, 1e-4), electronic, 0.0, wavelength, TRANSMITTER)
    truth = np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
    np.testing.assert_allclose(to_first(result.range_difference_m), to_first(truth), atol=1e-9)
    assert np.all(result.status == RangeStatus.OK)
    assert np.all(result.range_difference_m[np.arange(300), result.reference] == 0.0)


def test_sigma_is_that_of_the_scatter_and_weighs_the_tones_by_inverse_variance():
    """20 000 rows: one sigma of a standard deviation is 0.5 %."""
    rng = np.random.default_rng(2)
    receiver = np.broadcast_to([10.0, 20.0, 2.0], (20_000, 3))
    # sigma in metres 0.064 and 0.051: both tones count
    sigma = np.array([1e-3, 8e-3])
    phase = phases(rng, receiver, WAVELENGTH, sigma_rad=sigma)
    result = range_differences(phase, np.broadcast_to(sigma, phase.shape), 0.0, 0.0, WAVELENGTH, TRANSMITTER)
    per_tone = sigma * WAVELENGTH / (2 * np.pi)
    expected = np.sum(per_tone**-2.0) ** -0.5
    np.testing.assert_allclose(result.sigma_m, expected, rtol=1e-9)
    scatter = np.std(np.diff(result.range_difference_m, axis=1), axis=0) / np.sqrt(2)
    np.testing.assert_allclose(scatter, expected, rtol=0.025)


def test_unequal_noise_of_the_tones_leaves_no_trace_of_the_reference():
    """Tones weigh differently from transmitter to transmitter; differences still have the noise stated."""
    rng = np.random.default_rng(3)
    receiver = np.broadcast_to([10.0, 20.0, 2.0], (20_000, 3))
    sigma = np.stack([np.full(10, 1e-3), np.linspace(2e-3, 3e-2, 10)], axis=-1)
    sigma[9] = [5e-3, 5e-2]  # the reference is the worst of all
    phase = phases(rng, receiver, WAVELENGTH, sigma_rad=sigma)
    result = range_differences(phase, np.broadcast_to(sigma, phase.shape), 0.0, 0.0, WAVELENGTH, TRANSMITTER)
    assert np.all(result.reference == 9)
    assert np.all(result.status == RangeStatus.OK)
    stated = result.sigma_m[0]
    scatter, expected = 0.0, 0.0
    for i in range(10):
        for j in range(i):
            scatter += np.var(result.range_difference_m[:, i] - result.range_difference_m[:, j])
            expected += stated[i] ** 2 + stated[j] ** 2
    assert scatter == pytest.approx(expected, rel=0.05)


def test_calibration_noise_is_kept_apart():
    rng = np.random.default_rng(4)
    phase = phases(rng, [[0.0, 0.0, 2.0]], WAVELENGTH[:1])
    result = range_differences(phase, np.full(phase.shape, 3e-4), 0.0, 4e-4, WAVELENGTH[:1], TRANSMITTER)
    per_rad = 400.0 / (2 * np.pi)
    np.testing.assert_allclose(result.sigma_m, 3e-4 * per_rad)
    np.testing.assert_allclose(result.calibration_sigma_m, 4e-4 * per_rad)


def test_a_fine_tone_that_cannot_be_counted_is_left_out():
    rng = np.random.default_rng(5)
    receiver = anywhere(rng, 200)
    sigma = np.array([0.2, 0.001])  # 12.7 m against half of 40 m: a wrong integer is likely
    phase = phases(rng, receiver, WAVELENGTH, sigma_rad=sigma)
    both = range_differences(phase, np.broadcast_to(sigma, phase.shape), 0.0, 0.0, WAVELENGTH, TRANSMITTER)
    coarse = range_differences(
        phase[..., :1], np.full((*phase.shape[:2], 1), 0.2), 0.0, 0.0, WAVELENGTH[:1], TRANSMITTER
    )
    usable = np.isfinite(both.range_difference_m)
    assert np.all(both.status[usable] == RangeStatus.TONE_FLOAT)
    np.testing.assert_allclose(both.range_difference_m, coarse.range_difference_m)
    np.testing.assert_allclose(both.sigma_m, coarse.sigma_m)


def test_integers_are_right_just_inside_the_gate():
    """At a probability of 1e-6 a difference, none of 90 000 may be wrong (expected 0.09)."""
    rng = np.random.default_rng(6)
    receiver = anywhere(rng, 10_000)
    sigma = np.array([0.9 * 20.0 / 4.892 / np.sqrt(2) * 2 * np.pi / 400.0, 1e-3])
    phase = phases(rng, receiver, WAVELENGTH, sigma_rad=sigma)
    truth = np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
    result = range_differences(phase, np.broadcast_to(sigma, phase.shape), 0.0, 0.0, WAVELENGTH, TRANSMITTER)
    fine = result.status == RangeStatus.OK
    assert fine.mean() > 0.9
    error = to_first(np.where(fine, result.range_difference_m, np.nan)) - to_first(truth)
    assert np.nanmax(np.abs(error)) < 10.0


def test_missing_transmitters_and_rows():
    rng = np.random.default_rng(7)
    phase = phases(rng, anywhere(rng, 3), WAVELENGTH)
    phase[0, 9] = np.nan
    phase[1] = np.nan
    phase[2, 4, 1] = np.nan
    result = range_differences(phase, np.full(phase.shape, 1e-4), 0.0, 0.0, WAVELENGTH, TRANSMITTER)
    assert result.status[0, 9] == RangeStatus.NOT_RECEIVED
    assert np.isnan(result.range_difference_m[0, 9])
    assert np.isfinite(result.range_difference_m[0, :9]).all()
    assert result.reference[0] != 9
    assert result.reference[1] == -1
    assert np.all(result.status[1] == RangeStatus.NOT_RECEIVED)
    assert result.status[2, 4] == RangeStatus.TONE_FLOAT
    assert result.sigma_m[2, 4] > result.sigma_m[2, 3]


def test_a_row_without_a_safe_reference_is_ambiguous_not_guessed():
    """At 210 m only the mast in the middle reaches all others; without it the far ones are unknown."""
    rng = np.random.default_rng(8)
    phase = phases(rng, anywhere(rng, 1), np.array([210.0]))
    phase[0, [6, 7, 8, 9]] = np.nan
    result = range_differences(phase, np.full(phase.shape, 1e-4), 0.0, 0.0, [210.0], TRANSMITTER)
    far = np.linalg.norm(TRANSMITTER - TRANSMITTER[result.reference[0]], axis=1) > 105.0
    assert far[:6].any()
    assert np.all(result.status[0, :6][far[:6]] == RangeStatus.AMBIGUOUS)
    assert np.isnan(result.range_difference_m[0, :6][far[:6]]).all()
    assert np.isfinite(result.range_difference_m[0, :6][~far[:6]]).all()


@pytest.mark.parametrize("wavelength", [[4.0], [150.0], [207.0], [40.0, 4.0]])
def test_a_field_wider_than_the_wavelength_is_refused_with_the_remedy(wavelength):
    with pytest.raises(
        GeometryError, match=r"ambiguous: the field is wider than .* add a tone of wavelength above 208"
    ):
        check_unambiguous(TRANSMITTER, wavelength)
    phase = np.zeros((1, 10, len(wavelength)))
    with pytest.raises(GeometryError, match="ambiguous"):
        range_differences(phase, phase + 1.0, 0.0, 0.0, wavelength, TRANSMITTER)


def test_leading_axes_are_kept():
    phase = np.zeros((2, 3, 10, 2))
    result = range_differences(phase, phase + 1e-4, np.zeros((2, 1, 10, 2)), 0.0, WAVELENGTH, TRANSMITTER)
    assert result.range_difference_m.shape == (2, 3, 10)
    assert result.reference.shape == (2, 3)
    assert not result.range_difference_m.flags.writeable


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"phase_rad": np.zeros((1, 9, 2))}, "phase_rad"),
        ({"sigma_rad": 0.0}, "sigma_rad"),
        ({"sigma_rad": np.ones((7, 1, 1))}, "broadcast"),
        ({"transmitter_phase_sigma_rad": -1.0}, "transmitter_phase_sigma_rad"),
        ({"wavelength_m": [400.0, -4.0]}, "wavelength_m"),
        ({"transmitter_enu_m": np.full((10, 3), np.nan)}, "transmitter_enu_m"),
    ],
)
def test_mistakes_are_named(change, match):
    arguments = {
        "phase_rad": np.zeros((1, 10, 2)),
        "sigma_rad": 1.0,
        "transmitter_phase_rad": 0.0,
        "transmitter_phase_sigma_rad": 0.0,
        "wavelength_m": WAVELENGTH,
        "transmitter_enu_m": TRANSMITTER,
    }
    with pytest.raises(InvalidInputError, match=match):
        range_differences(**{**arguments, **change})


def test_every_status_has_a_reason():
    assert all(status.reason for status in RangeStatus)
