"""Pictures of docs/pose.md, docs/ground-reflection.md and docs/integrity.md, into docs/images.

    .venv/bin/python scripts/figures_pose.py [-o DIRECTORY]

Everything is computed: bounds where a picture shows bounds, seeded Monte Carlo where it shows errors. Field of Table 2
times 100, receivers 1.73 m apart, 0.97 mm of noise a range as in the paper.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat.ground import Reflector, range_shift_m, solve_with_ground
from rfpose.multilat.integrity import Alarms, IntegrityStatus, solve_with_integrity
from rfpose.multilat.rigid import (
    MirrorKnowledge,
    MirrorProblem,
    Observation,
    full_covariance,
    rigid_bound,
    solve_rigid,
    tilt_sigma_rad,
)
from rfpose.multilat.rigid.delays import learn_delays
from rfpose.scenario import load_scenario

mpl.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
SITE = load_scenario(ROOT / "data" / "table2_100m.toml")
TRANSMITTER = SITE.transmitter_enu_m
PLACES = np.array(SITE.heliostat[0].receiver_mirror_m)
SPEED = 299_792_458.0
RANGE_SIGMA_M = 0.97e-3
COLOUR = {"three fits": "0.55", "three clocks": "tab:blue", "one clock": "tab:green", "carrier": "tab:orange"}


def rms(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


def mirrors(n: int, seed: int, *, inner: float = 5.0, outer: float = 95.0) -> tuple[np.ndarray, np.ndarray]:
    """Pivots in a ring of the field and orientations that look up and about."""
    rng = np.random.default_rng(seed)
    radius = np.sqrt(rng.uniform(inner**2, outer**2, n))
    angle = rng.uniform(0, 2 * np.pi, n)
    pivot = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, 2.0)])
    normal = rng.standard_normal((n, 3)) + np.array([0.0, 0.0, 1.5])
    return pivot, rot_enu_from_mirror(normal)


def distances(pivot: np.ndarray, rot: np.ndarray) -> np.ndarray:
    """(mirror, receiver, transmitter) [m]."""
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES)
    return np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)


def save(figure: plt.Figure, directory: Path, name: str) -> None:
    """Write a small PNG."""
    figure.tight_layout()
    figure.savefig(directory / f"{name}.png", dpi=90, metadata={"Software": None})
    plt.close(figure)


def bound(pivot: np.ndarray, rot: np.ndarray, sigma_m: list[float], known: MirrorKnowledge) -> np.ndarray:
    """Bound of the normal; more than one sigma: the second is the carrier's."""
    n = len(pivot)
    sigma = np.broadcast_to(np.array(sigma_m)[None, :, None, None], (n, len(sigma_m), 3, 10))
    common = np.broadcast_to(np.array([1e-7, np.inf])[None, : len(sigma_m), None], (n, len(sigma_m), 10))
    cov = rigid_bound(
        MirrorProblem.expected(
            TRANSMITTER,
            PLACES,
            pivot,
            rot,
            sigma_m=sigma,
            transmitter_sigma_m=common,
            clock_class=np.arange(len(sigma_m)),
            knowledge=known,
        )
    )
    return tilt_sigma_rad(cov, rot[:, :, 2])


def clocks(directory: Path) -> None:
    """One clock, three clocks, carrier: what each knows of the normal, over the field's radius."""
    radii = np.linspace(5.0, 95.0, 13)
    # the carrier at 100 MHz, twice the tone's power over m²: phase noise is m/√2 of the tone's
    carrier_m = RANGE_SIGMA_M * (0.75e6 / 100e6) * 0.8 / np.sqrt(2.0)
    forms = {
        "three clocks": ([RANGE_SIGMA_M], MirrorKnowledge()),
        "one clock": ([RANGE_SIGMA_M], MirrorKnowledge(clock_sigma_m=0.0)),
        "carrier": ([RANGE_SIGMA_M, carrier_m], MirrorKnowledge(clock_sigma_m=0.0)),
    }
    label = {
        "three clocks": "rigid, three clocks a frame",
        "one clock": "rigid, one clock",
        "carrier": "rigid, one clock, carrier of 100 MHz between receivers",
    }
    figure, axes = plt.subplots(figsize=(6.4, 3.8))
    for name, (sigma, known) in forms.items():
        values = [rms(bound(*mirrors(300, 1, inner=r, outer=r + 0.01), sigma, known)) for r in radii]
        axes.plot(radii, 1e3 * np.array(values), color=COLOUR[name], marker="o", label=label[name])
    axes.set(yscale="log", xlabel="distance from the centre of the field [m]", ylabel="normal, rms [mrad]")
    axes.set_title("Bound of the mirror normal, random postures, one 750 kHz tone")
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="center right", fontsize=9)
    save(figure, directory, "pose-clocks")


def delays(directory: Path) -> None:
    """Delays learned over frames at several drift rates; the curve is the bound, dots are errors."""
    n, n_frame = 200, 60
    rng = np.random.default_rng(2)
    pivot, rot = mirrors(n, 3)
    common = {
        "sigma_m": np.full((n, 1, 3, 10), RANGE_SIGMA_M),
        "transmitter_sigma_m": 1e-7,
        "clock_class": [0],
    }
    whole = full_covariance(MirrorProblem.expected(TRANSMITTER, PLACES, pivot, rot, **common))
    one = rms(bound(pivot, rot, [RANGE_SIGMA_M], MirrorKnowledge(clock_sigma_m=0.0)))
    three = rms(tilt_sigma_rad(whole[:, :6, :6], rot[:, :, 2]))
    figure, axes = plt.subplots(figsize=(6.4, 3.8))
    for rate_ps, colour in ((0.1, "tab:green"), (1.0, "tab:blue"), (10.0, "tab:orange"), (100.0, "tab:red")):
        rate = rate_ps * 1e-12 * SPEED / np.sqrt(60.0)
        time = 60.0 * np.arange(n_frame)
        delay = 1e-9 * SPEED * rng.standard_normal((n, 3))
        found = {"pivot": [], "rot": [], "clock": []}
        distance = np.linalg.norm(
            (pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES))[:, :, None] - TRANSMITTER, axis=-1
        )
        for _ in range(n_frame):
            delay = delay + rate * np.sqrt(60.0) * rng.standard_normal(delay.shape)
            z = distance + delay[:, :, None] + RANGE_SIGMA_M * rng.standard_normal(distance.shape)
            solved = solve_rigid(
                MirrorProblem.of(
                    TRANSMITTER, PLACES, z[:, None], start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot, **common
                )
            )
            for name, values in (
                ("pivot", solved.pivot_enu_m),
                ("rot", solved.rot_enu_from_mirror),
                ("clock", solved.clock_m),
            ):
                found[name].append(values)
        learned = learn_delays(
            np.array(found["pivot"]),
            np.array(found["rot"]),
            np.array(found["clock"]),
            np.broadcast_to(whole, (n_frame, *whole.shape)),
            time_s=time,
            drift_m_per_sqrt_s=rate,
        )
        error = angle_between_rad(learned.rot_enu_from_mirror[..., 2], rot[:, :, 2])
        sigma = tilt_sigma_rad(learned.cov, rot[:, :, 2])
        frames = 1 + np.arange(n_frame)
        axes.plot(frames, 1e3 * rms(sigma, 1), color=colour, label=f"{rate_ps:g} ps/√min")
        axes.plot(frames, 1e3 * rms(error, 1), ".", color=colour, markersize=4)
        print(
            f"delays drifting {rate_ps:g} ps/sqrt(min): frame 50 at {rms(error[45:55]) / one:.3f} of one clock's bound"
        )
    for value, name in ((one, "one clock"), (three, "three clocks")):
        axes.hlines(1e3 * value, 0, n_frame + 1, color="0.4", linestyle="--", linewidth=1)
        axes.text(n_frame + 1.5, 1e3 * value, name, ha="left", va="center", fontsize=9, color="0.3")
    axes.set(xlabel="frame, a minute each", ylabel="normal, rms [mrad]", xlim=(0, n_frame + 12))
    axes.set_title("Delays between receivers learned (lines: stated sigma, dots: error)")
    axes.set_ylim(0.0, 1.35e3 * three)
    axes.legend(title="drift of each delay", fontsize=9, loc="lower left", ncols=2)
    axes.grid(alpha=0.3)
    save(figure, directory, "pose-delays")


def edge() -> None:
    """Print what learned delays leave where one clock is worth most: at the edge, facing the tower."""
    pivot, rot, n_frame = np.array([[100.0, 0.0, 0.0]]), rot_enu_from_mirror(np.array([[-1.0, 0.0, 1.0]])), 50
    one = bound(pivot, rot, [RANGE_SIGMA_M], MirrorKnowledge(clock_sigma_m=0.0))[0]
    whole = full_covariance(
        MirrorProblem.expected(
            TRANSMITTER,
            PLACES,
            pivot,
            rot,
            sigma_m=np.full((1, 1, 3, 10), RANGE_SIGMA_M),
            transmitter_sigma_m=1e-7,
            clock_class=[0],
        )
    )
    for rate_ps, interval_s in ((0.0, 60.0), (1.0, 1.0), (1.0, 10.0), (1.0, 60.0)):
        learned = learn_delays(
            np.tile(pivot, (n_frame, 1, 1)),
            np.tile(rot, (n_frame, 1, 1, 1)),
            np.zeros((n_frame, 1, 1, 3)),
            np.tile(whole, (n_frame, 1, 1, 1)),
            time_s=interval_s * np.arange(n_frame),
            drift_m_per_sqrt_s=rate_ps * 1e-12 * SPEED / np.sqrt(60.0),
        )
        ratio = tilt_sigma_rad(learned.cov[-1], rot[:, :, 2])[0] / one
        print(f"edge, {rate_ps:g} ps/sqrt(min), {interval_s:g} s apart: frame 50 at {ratio:.2f} of one clock's bound")


def reflection(directory: Path) -> None:
    """Error of the normal over the coefficient's size: ignored, estimated, without any reflection."""
    n, rf_hz = 60, 100e6
    carrier_hz = rf_hz + SITE.carrier_hz
    tones = np.array([0.75e6, 7.5e6])
    sigma_m = 80e-6 * SPEED / (2.0 * np.pi * tones)
    pivot, rot = mirrors(n, 5, inner=10.0)
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES)
    distance = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)
    known = MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=pivot, pivot_sigma_m=0.005)
    sizes = np.array([0.0, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5])
    error = {"ignored": [], "estimated": []}
    flagged = []
    for k, size in enumerate(sizes):
        rng = np.random.default_rng(10 + k)
        coefficient = size * np.exp(1j * 2.8)
        shift = range_shift_m(
            TRANSMITTER,
            receiver.reshape(-1, 3),
            reflectors=[Reflector(coefficient=complex(coefficient))],
            carrier_rf_hz=carrier_hz,
            tone_hz=tones,
        ).reshape(n, 3, 10, 2)
        start = np.array([r @ q for r, q in zip(rot, rot_from(rng, n), strict=True)])
        phases = [
            Observation(
                range_m=distance + shift[..., q] + sigma_m[q] * rng.standard_normal(distance.shape),
                sigma_m=np.full(distance.shape, sigma_m[q]),
                transmitter_sigma_m=np.full((n, 10), np.inf),
                wavelength_m=np.full(10, SPEED / tones[q]),
                clock_class=0,
            )
            for q in range(2)
        ]
        problem = MirrorProblem.of_observations(
            TRANSMITTER, PLACES, phases, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=start, knowledge=known
        )
        ignored = solve_with_ground(problem, carrier_rf_hz=carrier_hz, reflectors=())
        estimated = solve_with_ground(problem, carrier_rf_hz=carrier_hz)
        for name, found in (("ignored", ignored), ("estimated", estimated)):
            off = angle_between_rad(found.poses.normal_enu, rot[:, :, 2])
            error[name].append(1e3 * rms(off[np.isfinite(off)]))
        flagged.append(np.mean(estimated.probability_direct < 1e-3))
    figure, axes = plt.subplots(figsize=(6.4, 3.8))
    at = np.maximum(sizes, 0.003)
    axes.plot(at, error["ignored"], "o-", color="tab:red", label="reflection ignored")
    axes.plot(at, error["estimated"], "o-", color="tab:green", label="coefficient estimated with the poses")
    for x, y, share in zip(at, error["ignored"], flagged, strict=True):
        axes.annotate(
            f"{100 * share:.0f} %", (x, y), textcoords="offset points", xytext=(0, 7), ha="center", fontsize=8
        )
    axes.set(xscale="log", yscale="log", xlabel="size of the reflection coefficient", ylabel="normal, rms [mrad]")
    axes.set_xticks([0.003, 0.01, 0.03, 0.1, 0.3, 0.5], ["0", "0.01", "0.03", "0.1", "0.3", "0.5"])
    axes.minorticks_off()
    axes.set_ylim(top=6e3)
    axes.set_title(
        "Ground reflection, RF 100 MHz, tones 0.75 and 7.5 MHz\n"
        "(per cent: mirrors whose residuals say that it is needed)"
    )
    axes.legend(loc="upper left", fontsize=9)
    axes.grid(alpha=0.3)
    save(figure, directory, "pose-reflection")


def rot_from(rng: np.random.Generator, n: int) -> np.ndarray:
    """Rotations of 0.1 rad about random axes."""
    from scipy.spatial.transform import Rotation

    axis = rng.standard_normal((n, 3))
    return Rotation.from_rotvec(0.1 * axis / np.linalg.norm(axis, axis=1, keepdims=True)).as_matrix()


def integrity(directory: Path) -> None:
    """Error of the normal with one bad transmitter, with and without tests, and how often it is found."""
    n = 400
    pivot, rot = mirrors(n, 8)
    distance = distances(pivot, rot)
    common = {
        "sigma_m": np.full((n, 1, 3, 10), RANGE_SIGMA_M),
        "transmitter_sigma_m": RANGE_SIGMA_M,
        "clock_class": [0],
        "start_pivot_enu_m": pivot,
        "start_rot_enu_from_mirror": rot,
        "knowledge": MirrorKnowledge(clock_sigma_m=0.0),
    }
    sizes = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 300.0, 1000.0])
    plain, guarded, found, level = [], [], [], []
    for k, size in enumerate(sizes):
        rng = np.random.default_rng(30 + k)
        z = distance + RANGE_SIGMA_M * (rng.standard_normal(distance.shape) + rng.standard_normal((n, 1, 10)))
        who = rng.integers(0, 10, n)
        z[np.arange(n), :, who] += size * RANGE_SIGMA_M * rng.choice([-1.0, 1.0], (n, 3))
        raw = solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, z[:, None], **common))
        safe = solve_with_integrity(
            MirrorProblem.of(TRANSMITTER, PLACES, z[:, None], **common), Alarms(false_alarm=1e-3)
        )
        ruined = angle_between_rad(raw.normal_enu, rot[:, :, 2])
        plain.append(rms(ruined[np.isfinite(ruined)]))
        off = angle_between_rad(safe.poses.normal_enu, rot[:, :, 2])
        guarded.append(rms(off[safe.status != IntegrityStatus.UNEXPLAINED]))
        found.append(np.mean(safe.transmitter_status[np.arange(n), who] > 1))
        level.append(np.median(safe.protection_level_rad))
        over = np.mean(off > safe.protection_level_rad)
        print(f"integrity, {size:g} sigma: found {found[-1]:.3f}, error over protection level in {over:.4f}")
    figure, axes = plt.subplots(figsize=(6.4, 3.8))
    axes.plot(sizes, 1e3 * np.array(plain), "o-", color="tab:red", label="without tests")
    axes.plot(sizes, 1e3 * np.array(guarded), "o-", color="tab:green", label="tested, the bad transmitter left out")
    axes.plot(sizes, 1e3 * np.array(level), "--", color="tab:blue", label="protection level, median")
    for x, y, share in zip(sizes, guarded, found, strict=True):
        axes.annotate(
            f"{100 * share:.0f} %", (x, 1e3 * y), textcoords="offset points", xytext=(0, -14), ha="center", fontsize=8
        )
    axes.set(xscale="log", yscale="log", ylabel="normal [mrad]")
    axes.set_xlabel("error of one transmitter, its sign drawn at each receiver [sigma of a range]")
    axes.set_title("One bad transmitter in ten, one clock a mirror (per cent: found)")
    axes.set_ylim(bottom=0.35e3 * min(guarded))
    axes.legend(fontsize=9)
    axes.grid(alpha=0.3)
    save(figure, directory, "pose-integrity")


def main() -> None:
    """Draw all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "images")
    directory = parser.parse_args().output
    directory.mkdir(parents=True, exist_ok=True)
    for draw in (clocks, delays, integrity, reflection):
        draw(directory)
    edge()


if __name__ == "__main__":
    main()
