#!/usr/bin/env bash
# sionna-rt 2.2.0: PathSolver(deterministic=True) finds only some of the diffracted paths of a small, distant plate.
#
# Good guess: for a scene of two triangles the candidates are enumerated, so every diffracted path is there, as direct
#             and reflected ones are; surely so with `deterministic=True`.
# Behaviour:  candidates come from rays launched all round the transmitter, and a ray that meets the plate picks an edge
#             by chance, one time in five. An edge that no ray picked has no diffracted path at any receiver, with no
#             warning; `deterministic` makes that repeatable for a seed, not complete. Direct and reflected paths are
#             complete much sooner. The number of samples that is needed grows as the square of distance over size.
# Seen:       diffracted paths of 16, seeds 1 to 5: 8 8 0 8 4 with 100,000 samples at 60 m, 16 12 12 8 16 with 300,000,
#             all with 1,000,000; at 100 m 4 4 4 4 0, 4 8 8 8 4, 16 16 8 12 16, and all with 3,000,000. All direct and
#             reflected paths in every run.
# So rays of tables by this tracer must not be read as all the edges that bend; rfpose enumerates edges itself.
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
from sionna.rt import PathSolver, PlanarArray, RadioMaterial, Receiver, SceneObject, Transmitter, load_scene

RECEIVERS = [(1.0, 0.1, 0.2), (2.0, -0.3, 0.2), (3.0, 0.2, -0.4), (5.0, 0.3, 0.1)]  # before the plate: it mirrors
SEEDS = (1, 2, 3, 4, 5)


def build(distance):
    """A metal plate of 2 m x 2 m in the plane x = 0, a transmitter far before it and four receivers close by."""
    scene = load_scene()
    scene.frequency = 433e6
    one = {"num_rows": 1, "num_cols": 1, "vertical_spacing": 0.5, "horizontal_spacing": 0.5}
    scene.tx_array = scene.rx_array = PlanarArray(**one, pattern="iso", polarization="V")
    metal = RadioMaterial("metal", thickness=0.01, relative_permittivity=1.0, conductivity=1e7)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "plate.ply")
        with open(path, "w") as file:
            file.write("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n")
            file.write("property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n")
            file.write("0 -1 -1\n0 1 -1\n0 1 1\n0 -1 1\n3 0 1 2\n3 0 2 3\n")
        scene.edit(add=[SceneObject(fname=path, name="plate", radio_material=metal)])
    scene.add(Transmitter(name="t", position=mi.Point3f(distance, 5.0, 3.0)))
    for k, place in enumerate(RECEIVERS):
        scene.add(Receiver(name=f"r{k}", position=mi.Point3f(*place)))
    return scene


def count(scene, samples, seed):
    """Direct, reflected and diffracted paths of the four receivers together."""
    paths = PathSolver(deterministic=True)(
        scene,
        max_depth=1,
        samples_per_src=samples,
        refraction=False,
        diffraction=True,
        edge_diffraction=True,
        seed=seed,
    )
    kind = np.array(paths.interactions)[0][np.array(paths.valid)]
    return [int((kind == k).sum()) for k in (0, 1, 8)]


print("sionna-rt", version("sionna-rt"), "- four receivers 1 m to 5 m before one plate of four edges; seeds 1 to 5")
print("transmitter  samples_per_src  direct (of 4)  reflected (of 4)  diffracted (of 16)")
found = {}
for distance in (60.0, 100.0):
    scene = build(distance)
    for samples in (100_000, 300_000, 1_000_000, 3_000_000):
        if (distance, samples) == (60.0, 3_000_000):
            continue  # complete before
        rows = found[distance, samples] = np.array([count(scene, samples, seed) for seed in SEEDS])
        words = [" ".join(map(str, column)) for column in rows.T]
        print(f"{distance:5.0f} m  {samples:15,}      {words[0]:13}  {words[1]:16}  {words[2]}", flush=True)
some, many = found[60.0, 300_000], found[60.0, 1_000_000]
holds = np.all(some[:, :2] == 4) and np.any(some[:, 2] < 16) and np.all(many == (4, 4, 16))
sys.exit(0 if holds else 1)
PY
