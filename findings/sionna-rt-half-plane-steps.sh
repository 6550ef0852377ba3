#!/usr/bin/env bash
# sionna-rt 2.2.0: the field about the edge of a metal half-plane jumps where the reflection ends.
#
# Good guess: with `diffraction=True, edge_diffraction=True`, the sum of direct, reflected and diffracted paths goes on
#             smoothly where a reflection ends: uniform theory of diffraction is for that, and Sommerfeld's field does.
# Behaviour:  it goes on where the shadow begins, but where the reflection ends it steps by twice the reflected field,
#             in either polarisation: the diffracted field steps with the reflected one, not against it.
# Seen:       step of the total across the end of reflection: Sionna RT 1.995, Sommerfeld 0.059 (E along the edge);
#             1.993 and 0.068 (H along the edge); across the begin of shadow 0.006 and 0.006 in both.
# rfpose's coefficients are uniform by default (Sommerfeld's here); tables of this tracer hold its own, which
# `wedge = "sionna"` repeats for comparing.
# Exits 0 while this holds, 1 when it has changed, 2 where it cannot run.
set -euo pipefail
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ]; then
    PATH="$PATH:/sbin:/usr/sbin"
    DRJIT_LIBLLVM_PATH=$(ldconfig -p | awk '/libLLVM(-19\.so|\.so\.19)/ && !n++ { print $NF }') || true
fi
if [ ! -e "$DRJIT_LIBLLVM_PATH" ]; then
    echo "needs LLVM 19's shared library: Debian's package libllvm19; elsewhere set DRJIT_LIBLLVM_PATH to it" >&2
    exit 2
fi
export DRJIT_LIBLLVM_PATH
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    sionna-rt==2.2.0 mitsuba==3.9.1 drjit==1.5.0 numpy==2.4.6 scipy==1.17.1 2>/dev/null || {
    echo "pip could not install the pinned packages (they need Python 3.11 or later)" >&2
    exit 2
}
"$folder/venv/bin/python" - <<'PY'
import os
import sys
import tempfile
from importlib.metadata import version

import mitsuba as mi
import numpy as np
from scipy.special import fresnel
from sionna.rt import PathSolver, PlanarArray, RadioMaterial, Receiver, SceneObject, Transmitter, load_scene

FREQUENCY, FAR_M, NEAR_M = 1e9, 1000.0, 1.0
WAVE = 299_792_458.0 / FREQUENCY
K = 2 * np.pi / WAVE
FROM = np.radians(60.0)  # the transmitter's angle from the sheet: reflection ends at 120 degrees, shadow begins at 240
ANGLES = (90.0, 110.0, 119.9, 120.1, 130.0, 160.0, 239.9, 240.1, 260.0)


def at(radius, angle):
    return np.array([radius * np.cos(angle), radius * np.sin(angle), 0.0])


def sommerfeld(angle, sign):
    """Field of a plane wave about a half-plane that conducts; sign -1: E along the edge, +1: H along it."""

    def part(beta):
        # e^{j pi/4}/sqrt(pi) e^{j kr cos beta} times the integral of e^{-j t^2} from -sqrt(2 kr) cos(beta/2) on
        sine, cosine = fresnel(-np.sqrt(4 * K * NEAR_M / np.pi) * np.cos(beta / 2))
        return np.exp(1j * (np.pi / 4 + K * NEAR_M * np.cos(beta))) / 2**0.5 * (0.5 - cosine - 1j * (0.5 - sine))

    return part(angle - FROM) + sign * part(angle + FROM)


def traced(polarization):
    """Sums of direct, reflected and diffracted paths at ANGLES, against the plane wave's field at the edge."""
    scene = load_scene()
    scene.frequency = FREQUENCY
    one = {"num_rows": 1, "num_cols": 1, "vertical_spacing": 0.5, "horizontal_spacing": 0.5}
    scene.tx_array = scene.rx_array = PlanarArray(**one, pattern="iso", polarization=polarization)
    metal = RadioMaterial("metal", thickness=0.01, relative_permittivity=1.0, conductivity=1e7)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "sheet.ply")
        with open(path, "w") as file:  # 200 m x 400 m; its edge at hand is the z axis
            file.write("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n")
            file.write("property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n")
            file.write("0 0 -200\n200 0 -200\n200 0 200\n0 0 200\n3 0 1 2\n3 0 2 3\n")
        scene.edit(add=[SceneObject(fname=path, name="sheet", radio_material=metal)])
    source = at(FAR_M, FROM)
    scene.add(Transmitter(name="t", position=mi.Point3f(*map(float, source))))
    places = [at(NEAR_M, np.radians(angle)) for angle in ANGLES]
    for k, place in enumerate(places):
        scene.add(Receiver(name=f"r{k}", position=mi.Point3f(*map(float, place))))
    paths = PathSolver()(
        scene, max_depth=1, samples_per_src=1_000_000, refraction=False, diffraction=True, edge_diffraction=True
    )
    a = (np.array(paths.a[0]) + 1j * np.array(paths.a[1]))[:, 0, 0, 0, :]
    valid = np.array(paths.valid)[:, 0, :]
    kinds, points = np.array(paths.interactions)[0, :, 0], np.array(paths.vertices, np.float64)[0, :, 0]
    rows = []
    for r, place in enumerate(places):
        row = {0: 0.0, 1: 0.0, 8: 0.0}
        for q in np.flatnonzero(valid[r]):
            kind, point = int(kinds[r, q]), points[r, q]
            if kind == 8 and np.hypot(*point[:2]) > 0.01:
                continue  # the sheet's other edges are far and no part of the question
            legs = [source - place] if kind == 0 else [source - point, point - place]
            length = sum(np.linalg.norm(leg) for leg in legs)
            # the unit vector of H turns about between a ray's departure and its arrival
            turn = 1 if polarization == "V" else -1
            row[kind] += turn * a[r, q] * 4 * np.pi * FAR_M / WAVE * np.exp(-1j * K * (length - FAR_M))
        rows.append(row)
    return rows


print("sionna-rt", version("sionna-rt"), "- |field| and phase, 3.3 wavelengths from the edge of a metal half-plane")
holds = True
for polarization, sign, words in (("V", -1, "E along the edge"), ("H", 1, "H along the edge")):
    print(f"{words}; reflection ends at 120 degrees, shadow begins at 240")
    print("angle        direct    reflected   diffracted        total   Sommerfeld")
    ours, theirs = {}, {}
    for angle, row in zip(ANGLES, traced(polarization), strict=True):
        ours[angle], theirs[angle] = sommerfeld(np.radians(angle), sign), sum(row.values())
        fields = (*row.values(), theirs[angle], ours[angle])
        cells = (f"{abs(one):.3f} {np.degrees(np.angle(one)):+5.0f}" for one in fields)
        print(f"{angle:5.1f}   " + "   ".join(cells))
    for words, low, high in (("end of reflection", 119.9, 120.1), ("begin of shadow", 239.9, 240.1)):
        jumps = [abs(field[high] - field[low]) for field in (theirs, ours)]
        print(f"step of the total across the {words}: Sionna RT {jumps[0]:.3f}, Sommerfeld {jumps[1]:.3f}")
        holds &= jumps[1] < 0.1 and (jumps[0] > 1.8 if low < 180 else jumps[0] < 0.1)
sys.exit(0 if holds else 1)
PY
