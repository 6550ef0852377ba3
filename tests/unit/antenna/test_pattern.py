"""Patterns and their tables: closed forms, poles, gaps, frequencies, and what is refused."""

import dataclasses

import numpy as np
import pytest

from rfpose.antenna import AntennaPattern, components, dipole_pattern, grid_directions
from rfpose.errors import InvalidInputError

SPEED = 299_792_458.0
PLACES = np.array([[1.0, 0.0, 0.1], [-0.5, 0.8, 0.1]])
POLES = [[0, 0, 1.0], [0, 0, -1.0], [1e-9, 0, 1], [0, 1e-4, -1], [-1e-7, 1e-7, 1]]


def directions(n, seed=1):
    found = np.random.default_rng(seed).standard_normal((n, 3))
    return np.vstack([POLES, found / np.linalg.norm(found, axis=1)[:, None]])


def tangential(vector, direction):
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return vector - np.sum(vector * direction, axis=-1, keepdims=True) * direction


def pattern_of(function, *, steps=61, frequency_hz=(433e6,), places=PLACES):
    """Pattern whose effective lengths are function(direction, receiver, frequency)."""
    grid = grid_directions(steps, 2 * steps - 2)
    vector = np.array([[function(grid, r, f) for r in range(len(places))] for f in frequency_hz], complex)
    return AntennaPattern(
        frequency_hz=frequency_hz,
        receiver_mirror_m=places,
        axis_mirror=np.tile([0.0, 1.0, 0.0], (len(places), 1)),
        response=components(vector),
        sigma=np.zeros(vector.shape[:-1]),
    )


def before_a_plate(direction, receiver, frequency_hz):
    """Dipole along y before an infinite conducting plate in z = 0, by its image: nothing reaches it from behind."""
    wave_number = 2 * np.pi * frequency_hz / SPEED
    height = PLACES[receiver, 2]
    factor = 1.0 - np.exp(-2j * wave_number * height * direction[..., 2])
    return factor[..., None] * tangential(np.array([0.0, 1.0, 0.0]), direction)


def test_a_dipole_is_its_axis_seen_from_the_direction():
    axes = np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8]])
    direction = directions(500)
    receiver = np.arange(len(direction)) % 2
    table = dipole_pattern(PLACES, axes, 433e6).table(433e6)
    vector, _, sigma = table.vector_and_slope(7.0 * direction, receiver)
    np.testing.assert_allclose(vector, tangential(axes[receiver], direction), atol=2e-7)
    assert not sigma.any()


def test_image_theory_is_looked_up_between_the_points_of_the_table():
    direction = directions(500)
    receiver = np.arange(len(direction)) % 2
    expected = np.array([before_a_plate(d, r, 433e6) for d, r in zip(direction, receiver, strict=True)])
    coarse = pattern_of(before_a_plate, steps=16).table(433e6)  # 12 degrees
    # the table carries 15 orders; the wave in twice the height has kd = 1.8, and 4e-6 of it beyond 10
    np.testing.assert_allclose(coarse.vector(direction, receiver), expected, atol=2e-5)


@pytest.mark.parametrize("reach_m", [0.5, 2.0])
def test_slope_is_the_derivative(reach_m):
    def far_image(direction, receiver, frequency_hz):
        phase = 2 * np.pi * frequency_hz / SPEED * (direction @ [reach_m, 0.3 * receiver, 0.2])
        return np.exp(1j * phase)[..., None] * tangential(np.array([0.0, 1.0, 0.3]), direction)

    table = pattern_of(far_image).table(433e6)
    direction = directions(300) * 2.0  # of any length
    receiver = np.arange(len(direction)) % 2
    slope = table.vector_and_slope(direction, receiver)[1]
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        numeric = (table.vector(direction + shift, receiver) - table.vector(direction - shift, receiver)) / (2 * step)
        # the slope may jump in its third derivative from cell to cell, so much over a step
        np.testing.assert_allclose(slope[:, :, axis], numeric, atol=1e-4 * np.abs(slope).max())
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slope, direction), 0.0, atol=1e-6)


def test_frequencies_between_are_interpolated_and_beyond_are_refused():
    pattern = pattern_of(before_a_plate, steps=31, frequency_hz=(425e6, 433e6, 441e6))
    direction, receiver = directions(50), 0
    for mhz in (425, 433, 441):
        expected = before_a_plate(direction, 0, mhz * 1e6)
        np.testing.assert_allclose(pattern.table(mhz * 1e6).vector(direction, receiver), expected, atol=1e-5)
    # halfway between, what is left is the third derivative: (k · way)³ / 16 of the image, which is of size one
    between = pattern.table(429e6).vector(direction, receiver)
    way = 2.0 * np.abs(PLACES[0][2])
    left = (2.0 * np.pi * 8e6 / 299_792_458.0 * way) ** 3 / 16.0
    np.testing.assert_allclose(between, before_a_plate(direction, 0, 429e6), atol=max(1e-5, 2.0 * left))
    pattern.table(433e6)
    with pytest.raises(InvalidInputError, match="425 to 441 MHz"):
        pattern.table(400e6)


def test_a_gap_is_a_dipole_with_its_whole_size_as_sigma():
    whole = pattern_of(before_a_plate)
    response = whole.response.copy()
    lacking = grid_directions(61, 120)[..., 2] < -0.5
    response[:, 0, lacking, 0] = np.nan
    pattern = dataclasses.replace(whole, response=response)
    table = pattern.table(433e6)
    direction = directions(4000)
    vector, slope, sigma = table.vector_and_slope(direction, 0)
    assert np.isfinite(vector).all()
    assert np.isfinite(slope).all()
    deep, far = direction[:, 2] < -0.7, direction[:, 2] > -0.3
    np.testing.assert_allclose(vector[deep], tangential(np.array([0.0, 1.0, 0.0]), direction)[deep], atol=2e-2)
    np.testing.assert_array_equal(sigma[deep], 1.0)
    assert sigma[far].max() < 1e-2
    error = np.abs(vector - before_a_plate(direction, 0, 433e6)).max(axis=1)
    assert error[far].max() < 1e-3
    assert np.all(error <= 3.0 * sigma + 1e-3)
    np.testing.assert_array_equal(table.vector_and_slope(direction, 1)[2], 0.0)


def test_directions_that_are_none_become_nan():
    table = dipole_pattern(PLACES, [0, 1, 0], 433e6).table(433e6)
    vector, slope, sigma = table.vector_and_slope([[np.nan, 0, 1], [0, 0, 0], [np.inf, 0, 0], [0, 0, 1]], [0, 0, 0, 0])
    assert np.isnan(vector[:3]).all()
    assert np.isnan(slope[:3]).all()
    assert np.isnan(sigma[:3]).all()
    assert np.isfinite(vector[3]).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frequency_hz": [433e6, 433e6]}, "frequency_hz"),
        ({"frequency_hz": [-1.0]}, "frequency_hz"),
        ({"receiver_mirror_m": [[0, 0, np.nan], [0, 0, 0]]}, "receiver_mirror_m"),
        ({"axis_mirror": [[0, 2.0, 0], [0, 1, 0]]}, "axis_mirror"),
        ({"response": np.zeros((1, 2, 61, 119, 2))}, "even"),
        ({"response": np.zeros((1, 3, 61, 120, 2))}, "shape"),
        ({"response": np.full((1, 2, 61, 120, 2), 1e9)}, "below"),
        ({"sigma": np.full((1, 2, 61, 120), -1.0)}, "sigma"),
        ({"sigma": np.full((1, 2, 61, 120), np.nan)}, "sigma"),
    ],
)
def test_what_cannot_be_a_pattern_is_refused(change, said):
    pattern = pattern_of(before_a_plate)
    with pytest.raises(InvalidInputError, match=said):
        dataclasses.replace(pattern, **change)


def test_a_pattern_of_other_receivers_is_told():
    pattern = dipole_pattern(PLACES, [0, 1, 0], 433e6)
    pattern.check_receivers(PLACES + np.array([0.01, 0, 0]))
    with pytest.raises(InvalidInputError, match="the mirror has 3"):
        pattern.check_receivers(np.zeros((3, 3)))
    with pytest.raises(InvalidInputError, match="same order"):
        pattern.check_receivers(PLACES[::-1])


@pytest.mark.parametrize(
    ("direction", "receiver", "said"),
    [
        ([[0, 0]], 0, "direction"),
        ([[0, 0, 1]], 2, "0 to 1"),
        ([[0, 0, 1]], [0, 0], "1 of"),
        ([[0, 0, 1]], 0.5, "index"),
    ],
)
def test_wrong_questions_are_refused(direction, receiver, said):
    with pytest.raises(InvalidInputError, match=said):
        dipole_pattern(PLACES, [0, 1, 0], 433e6).table(433e6).vector(direction, receiver)


def test_a_pattern_is_not_changed_from_outside():
    response = np.zeros((1, 2, 7, 12, 2), complex)
    pattern = AntennaPattern(
        frequency_hz=[1e8],
        receiver_mirror_m=PLACES,
        axis_mirror=np.tile([0.0, 1, 0], (2, 1)),
        response=response,
        sigma=np.zeros((1, 2, 7, 12)),
    )
    response[:] = 1.0
    assert not pattern.response.any()
    with pytest.raises(ValueError, match="read-only"):
        pattern.response[0] = 1.0
