"""What reflections add to ranges: against samples of modulated rays, Fresnel's formulas, and bad planes."""

import numpy as np
import pytest
from scipy.stats import qmc

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat.ground import Reflector, Surface, fresnel_coefficient, range_shift_m
from rfpose.multilat.ground.solve import turns

SPEED = 299_792_458.0
TRANSMITTER = np.array([[100.0, 0.0, 20.0], [-50.0, 86.6, 30.0]])
POINT = np.array([[12.0, -7.0, 2.3], [-40.0, 30.0, 4.1]])
CARRIER_RF_HZ = np.array([100.25e6, 101.5e6])
TILTED = Reflector(
    normal_enu=(0.03, -0.02, 1.0), point_enu_m=(1.0, 2.0, 0.2), coefficient=0.4 * np.exp(2.1j), name="slope"
)
WALL = Reflector(normal_enu=(-1.0, 0.1, 0.0), point_enu_m=(150.0, 0.0, 0.0), coefficient=-0.2 + 0.05j, name="wall")


def image_of(point: np.ndarray, plane: Reflector) -> np.ndarray:
    normal = np.array(plane.normal_enu) / np.linalg.norm(plane.normal_enu)
    return point - 2.0 * ((point - np.array(plane.point_enu_m)) @ normal) * normal


def demodulated_phase(point: np.ndarray, i: int, planes: list[Reflector], tone_hz: float) -> tuple[float, float]:
    """Phase of the demodulated tone and of the carrier, from samples of all rays; no line amplitudes used."""
    direct = np.linalg.norm(point - TRANSMITTER[i])
    rays = [(direct, 1.0 + 0.0j)]
    for plane in planes:
        length = np.linalg.norm(point - image_of(TRANSMITTER[i], plane))
        rays.append((length, plane.coefficient * direct / length))
    n = 4000
    t = np.arange(n) * (20.0 / tone_hz / n)
    received = np.zeros(n, complex)
    for length, gain in rays:
        delay = length / SPEED
        envelope = 1.0 + 0.8 * np.cos(2 * np.pi * tone_hz * (t - delay))
        received += gain * np.exp(-2j * np.pi * CARRIER_RF_HZ[i] * delay) * envelope
    carrier = received.mean()
    detected = (received * np.conj(carrier)).real
    tone = 2.0 * np.mean(detected * np.exp(-2j * np.pi * tone_hz * t))
    return float(np.angle(tone)), float(np.angle(carrier))


@pytest.mark.parametrize("planes", [[TILTED], [TILTED, WALL]], ids=["tilted ground", "ground and wall"])
@pytest.mark.parametrize("tone_hz", [0.75e6, 7.5e6])
def test_shift_is_what_samples_of_the_rays_show(planes, tone_hz):
    shift = range_shift_m(TRANSMITTER, POINT, reflectors=planes, carrier_rf_hz=CARRIER_RF_HZ, tone_hz=[tone_hz, 0.0])
    assert np.abs(shift).max() > 0.1
    for p, point in enumerate(POINT):
        for i in range(2):
            distance = np.linalg.norm(point - TRANSMITTER[i])
            tone, carrier = demodulated_phase(point, i, planes, tone_hz)
            wavelengths = SPEED / tone_hz, SPEED / CARRIER_RF_HZ[i]
            for k, (phase, wavelength) in enumerate(zip((tone, carrier), wavelengths, strict=True)):
                error = -phase * wavelength / (2 * np.pi) - distance - shift[p, i, k]
                error -= np.rint(error / wavelength) * wavelength
                assert abs(error) < 1e-9 * wavelength


def test_without_reflection_nothing_is_added():
    none = Reflector(coefficient=0.0)
    shift = range_shift_m(TRANSMITTER, POINT, reflectors=[none], carrier_rf_hz=CARRIER_RF_HZ, tone_hz=[1e6, 0.0])
    np.testing.assert_array_equal(shift, 0.0)


@pytest.mark.parametrize("polarisation", ["vertical", "horizontal"])
def test_fresnel_at_grazing_incidence_reverses_the_field(polarisation):
    surface = Surface(permittivity=10.0, conductivity_s_per_m=0.01, polarisation=polarisation)
    assert abs(fresnel_coefficient(surface, 1e-6, 1e8) + 1.0) < 1e-4


def test_fresnel_at_normal_incidence_and_at_brewsters_angle():
    # textbook: |Γ| = (√ε − 1)/(√ε + 1) straight down; vertical polarisation vanishes where tan(grazing) = 1/√ε
    down = fresnel_coefficient(Surface(permittivity=9.0, polarisation="horizontal"), np.pi / 2, 1e8)
    assert abs(down + 0.5) < 1e-12
    brewster = np.arctan(1.0 / 3.0)
    assert abs(fresnel_coefficient(Surface(permittivity=9.0), brewster, 1e8)) < 1e-12


def test_fresnel_surface_is_the_coefficient_at_the_rays_grazing_angle():
    surface = Surface(permittivity=8.0, conductivity_s_per_m=0.005)
    whole = range_shift_m(
        TRANSMITTER, POINT, reflectors=[Reflector(surface=surface)], carrier_rf_hz=CARRIER_RF_HZ, tone_hz=[5e6, 0.0]
    )
    for p, point in enumerate(POINT):
        for i in range(2):
            ray = point - image_of(TRANSMITTER[i], Reflector())
            grazing = np.arcsin(ray[2] / np.linalg.norm(ray))
            value = complex(fresnel_coefficient(surface, grazing, CARRIER_RF_HZ[i]))
            one = range_shift_m(
                TRANSMITTER,
                POINT,
                reflectors=[Reflector(coefficient=value)],
                carrier_rf_hz=CARRIER_RF_HZ,
                tone_hz=[5e6, 0.0],
            )
            np.testing.assert_allclose(whole[p, i], one[p, i], rtol=1e-9)


def test_transmitter_behind_the_reflector_is_refused_with_the_remedy():
    backwards = Reflector(name="tower", normal_enu=(0.0, 0.0, -1.0), coefficient=0.3)
    with pytest.raises(GeometryError, match=r"transmitter 1 lies 30 m behind reflector 'tower'.*turn `normal_enu`"):
        range_shift_m(TRANSMITTER, POINT, reflectors=[backwards], carrier_rf_hz=CARRIER_RF_HZ, tone_hz=[1e6])


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Reflector(normal_enu=(0.0, 0.0, 0.0)), "`normal_enu` of reflector 'ground' must not be zero"),
        (lambda: Reflector(coefficient=1.2), "must not exceed one in magnitude"),
        (lambda: Surface(permittivity=0.5), "`permittivity` must be greater than one"),
        (lambda: Surface(permittivity=5.0, conductivity_s_per_m=-1.0), "must not be negative"),
        (lambda: Surface(permittivity=5.0, polarisation="circular"), "'vertical' or 'horizontal'"),
        (
            lambda: range_shift_m(
                TRANSMITTER, POINT, reflectors=[Reflector()], carrier_rf_hz=CARRIER_RF_HZ, tone_hz=[1e6]
            ),
            "must have a coefficient each, 'ground' has none",
        ),
    ],
)
def test_bad_reflectors_are_refused_in_words(build, words):
    with pytest.raises(InvalidInputError, match=words):
        build()


def test_turns_to_begin_from_are_those_of_haltons_sequence():
    cube = 2.0 * qmc.Halton(3, scramble=False).random(200) - 1.0
    inside = cube[np.linalg.norm(cube, axis=1) <= 1.0]
    found = turns()
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_array_equal(np.diff(np.linalg.norm(found, axis=1)) >= 0.0, True)
    scale = np.linalg.norm(found[-1]) / np.linalg.norm(inside, axis=1).max()
    np.testing.assert_allclose(np.sort(found[1:], axis=0), np.sort(scale * inside, axis=0), atol=1e-15)
