"""Trace the rays of a site by Sionna RT, and write ray tables (docs/ray-tables.md) for `rfpose simulate`.

    python scripts/trace_sionna.py site.toml -o tables/ --frames 0,1

writes ``tables/site_frame0.npz`` and so on: the rays from every transmitter to every receiver of the scenario, in the
postures that its ``[simulation]`` gives a frame. What stands there is the scenario's: ``[site.structures]``, the
outlines of mirrors (``width_m``, ``height_m``), and the ground of ``[reflection]`` where that is a ``fresnel`` one.
``--what`` leaves things out: ``direct`` alone, ``ground`` too, ``field`` (boxes and plates, too), ``plates`` (and those
of mirrors with receivers), ``edges`` (and first-order diffraction), ``open`` (edges, without the plates of mirrors with
receivers: what to weigh with patterns that hold the own plate).

Needs the extra ``trace`` (Sionna RT) and LLVM 19: Debian's package ``libllvm19``; elsewhere DRJIT_LIBLLVM_PATH names
the library. What ray tracing cannot tell is said in docs/ray-tables.md.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import rfpose as rf
from rfpose import geometry
from rfpose.errors import InvalidInputError, RfposeError, ScenarioError
from rfpose.files import claim
from rfpose.pipeline.postures import commanded_normals
from rfpose.scenario import Box
from rfpose.truth import Truth

Array = npt.NDArray[np.float64]

WHAT = ("direct", "ground", "field", "plates", "edges", "open")
SPEED_MPS = 299_792_458.0
GROUND, RIM = "ground", "D:ground"
GROUND_HALF_WIDTH_M = 2000.0
THICK_M = 1000.0
"""Materials are slabs to Sionna RT; a half-space is one that nothing comes back from."""
LEAST_LOSS_S_PER_M = 3e-5
"""Times the root of the permittivity: what goes through such a slab and back is down by e^11 then."""
BASE_M = 0.01
"""Boxes begin so far above the ground, where faces would coincide."""
SAMPLES = {"direct": 100_000, "ground": 100_000}
EDGE_SAMPLES = 3_000_000
"""Edges are found by rays that happen to hit beside them: so many find those of a 2 m plate 100 m away
(findings/sionna-rt-edges-missed.sh)."""
METAL = (1.0, 1e7)
_REFLECTED, _DIFFRACTED = 1, 8


@dataclass(frozen=True, slots=True)
class Thing:
    """A mesh of one material; ``faces`` are (point, normal) of its planes, for exact images."""

    name: str
    vertices: Array
    triangles: list[tuple[int, int, int]]
    material: tuple[float, float]
    faces: list[tuple[Array, Array]] = field(default_factory=list)


# -- what stands there ---------------------------------------------------------------------------------------


def plate(name: str, centre: Array, rot: Array, size_m: Iterable[float]) -> Thing:
    """Return a metal rectangle."""
    u, v = (0.5 * s * rot[:, k] for k, s in enumerate(size_m))
    corners = np.array([centre - u - v, centre + u - v, centre + u + v, centre - u + v])
    return Thing(name, corners, [(0, 1, 2), (0, 2, 3)], METAL, [(centre, rot[:, 2])])


def box(standing: Box) -> Thing:
    """Return an upright box."""
    base, size = np.array(standing.base_enu_m), np.array(standing.size_m)
    sine, cosine = np.sin(np.radians(standing.azimuth_deg)), np.cos(np.radians(standing.azimuth_deg))
    axes = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    corners = [
        base + 0.5 * size[0] * a * axes[0] + 0.5 * size[1] * b * axes[1] + z * axes[2]
        for z in (BASE_M, size[2])
        for a, b in ring
    ]
    triangles = [(4, 5, 6), (4, 6, 7)]
    for a in range(4):
        b = (a + 1) % 4
        triangles += [(a, b, b + 4), (a, b + 4, a + 4)]
    faces = [(base + 0.5 * s * size[k] * axes[k], axes[k]) for k in (0, 1) for s in (-1.0, 1.0)]
    faces.append((base + size[2] * axes[2], axes[2]))
    return Thing(
        standing.id, np.array(corners), triangles, (standing.permittivity, standing.conductivity_s_per_m), faces
    )


def level_ground(material: tuple[float, float], height_m: float) -> Thing:
    """Return the ground, wide enough for its rim to be far."""
    w, z = GROUND_HALF_WIDTH_M, height_m
    corners = np.array([(-w, -w, z), (w, -w, z), (w, w, z), (-w, w, z)], np.float64)
    return Thing(GROUND, corners, [(0, 1, 2), (0, 2, 3)], material, [(np.array([0.0, 0.0, z]), np.eye(3)[2])])


def things_of(site: rf.Scenario, normals: Array, what: str) -> list[Thing]:
    """Return what stands on a site; ``normals`` (mirror, xyz) are those of heliostats, then plates."""
    ground, found = site.reflection, []
    if what != "direct" and ground.permittivity is not None:
        found.append(level_ground((ground.permittivity, ground.conductivity_s_per_m), ground.height_m))
    if what in ("direct", "ground"):
        return found
    found += [box(one) for one in site.site.structures.box]
    with_own = what in ("plates", "edges")
    mirrors = [*(site.heliostat if with_own else ()), *site.site.structures.plate]
    for mirror, normal in zip(mirrors, normals[0 if with_own else len(site.heliostat) :], strict=True):
        if mirror.width_m is not None and mirror.height_m is not None:
            centre = np.array(mirror.pivot_enu_m) + mirror.arm_m * normal
            rot = geometry.rot_enu_from_mirror(normal)
            found.append(plate(mirror.id, centre, rot, (mirror.width_m, mirror.height_m)))
    return found


def mirrors_point(site: rf.Scenario, truth: Truth, frame: int) -> Array:
    """Return (mirror, xyz) normals of heliostats as simulated, then of plates as they were told."""
    unix_s = truth.frame_start_index / float(site.radio.sample_rate)
    told = commanded_normals(site, unix_s, simulated=True)[frame]
    normals = np.concatenate([truth.normal_enu[frame], told[len(site.heliostat) :]])
    lost = [
        p.id for p, n in zip(site.site.structures.plate, normals[len(site.heliostat) :], strict=True) if n[0] != n[0]
    ]
    if lost:
        raise ScenarioError(f"plate `{lost[0]}` has no posture in frame {frame}; give its `normal_enu`, or a sun")
    return normals


# -- Sionna RT -----------------------------------------------------------------------------------------------


def trace(site: rf.Scenario, frame: int, what: str = "edges") -> dict[str, Any]:
    """Return the columns of a ray table; a row a ray."""
    bare = site.changed(simulation=dict.fromkeys(("paths", "path_antenna", "paths_without")))
    truth = rf.simulate(bare, seed=0).truth
    if not 0 <= frame < len(truth.receiver_enu_m):
        raise InvalidInputError(f"frame {frame} is none of the scenario's {len(truth.receiver_enu_m)} (from 0)")
    receiver = truth.receiver_enu_m[frame]
    things = things_of(site, mirrors_point(site, truth, frame), what)
    paths, names = _solve(site, receiver, things, what)
    rows = [row for row in _rows(paths, names, things, site.transmitter_enu_m, receiver) if RIM not in row[-1]]
    rx, tx, a_theta, a_phi, length, theta_t, theta_r, phi_r, code = zip(*rows, strict=True)
    return {
        "rx": np.array(rx, np.int16),
        "tx": np.array(tx, np.int16),
        "a_theta": np.array(a_theta, np.complex64),
        "a_phi": np.array(a_phi, np.complex64),
        "length_m": np.array(length),
        "theta_t": np.array(theta_t, np.float32),
        "theta_r": np.array(theta_r, np.float32),
        "phi_r": np.array(phi_r, np.float32),
        "code": np.array(code, np.str_),
        "rx_names": np.array(site.receiver_ids),
        "rx_enu_m": receiver,
        "tx_enu_m": site.transmitter_enu_m,
        "frequency_hz": np.float64(site.radio.centre_frequency_hz),
    }


def _solve(site: rf.Scenario, receiver: Array, things: list[Thing], what: str) -> tuple[Any, dict[int, str]]:
    """Return the paths, and the things' names by Sionna RT's numbers."""
    try:
        import mitsuba as mi
        from sionna.rt import PathSolver, PlanarArray, RadioMaterial, Receiver, SceneObject, Transmitter, load_scene
    except ImportError as error:
        raise SystemExit(
            f"Sionna RT does not load: {error}; install the extra `trace`, and LLVM 19 (Debian: libllvm19; elsewhere "
            "set DRJIT_LIBLLVM_PATH)"
        ) from error

    def antenna(polarisation: str) -> Any:
        one = {"num_rows": 1, "num_cols": 1, "vertical_spacing": 0.5, "horizontal_spacing": 0.5}
        return PlanarArray(**one, pattern="iso", polarization=polarisation)

    scene = load_scene()
    scene.frequency = site.radio.centre_frequency_hz
    scene.tx_array, scene.rx_array = antenna("V"), antenna("VH")
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for k, thing in enumerate(things):
            # its own materials are refused below 1 GHz, so each has numbers
            permittivity, conductivity = thing.material
            material = RadioMaterial(
                f"m{k}",
                thickness=THICK_M,
                relative_permittivity=permittivity,
                conductivity=max(conductivity, LEAST_LOSS_S_PER_M * permittivity**0.5),
            )
            mesh = _written(thing, Path(folder) / f"{k}.ply")
            objects.append(SceneObject(fname=str(mesh), name=thing.name, radio_material=material))
        if objects:
            scene.edit(add=objects)
    names = {scene.objects[thing.name].object_id: thing.name for thing in things}
    for k, place in enumerate(site.transmitter_enu_m):
        scene.add(Transmitter(name=f"t{k}", position=mi.Point3f(*map(float, place))))
    for k, place in enumerate(receiver):
        scene.add(Receiver(name=f"r{k}", position=mi.Point3f(*map(float, place))))
    edges = what in ("edges", "open")
    paths = PathSolver()(
        scene,
        max_depth={"direct": 0, "ground": 1}.get(what, 2),
        samples_per_src=EDGE_SAMPLES if edges else SAMPLES.get(what, 300_000),
        refraction=False,
        synthetic_array=True,
        diffraction=edges,
        edge_diffraction=edges,  # without it thin plates do not diffract
    )
    return paths, names


def _written(thing: Thing, path: Path) -> Path:
    """Write a mesh as PLY."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(thing.vertices)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += f"element face {len(thing.triangles)}\nproperty list uchar int vertex_index\nend_header\n"
    lines = ["{:.9g} {:.9g} {:.9g}".format(*p) for p in thing.vertices]
    lines += ["3 {} {} {}".format(*t) for t in thing.triangles]
    path.write_text(header + "\n".join(lines) + "\n")
    return path


def _rows(
    paths: Any, names: dict[int, str], things: list[Thing], transmitter: Array, receiver: Array
) -> Iterable[tuple[Any, ...]]:
    """Yield receiver, transmitter, a_theta, a_phi, length, theta_t, theta_r, phi_r, code of each path."""
    a = (np.array(paths.a[0]) + 1j * np.array(paths.a[1]))[:, :, :, 0, :]
    valid = np.array(paths.valid)
    if valid.ndim == 5:
        valid = valid[:, 0, :, 0]
    angles = [np.array(x) for x in (paths.theta_t, paths.theta_r, paths.phi_r)]
    met, by, points = np.array(paths.interactions), np.array(paths.objects), np.array(paths.vertices, np.float64)
    faces = {thing.name: thing.faces for thing in things}
    for r, i, q in np.argwhere(valid):
        kinds = [int(k) for k in met[:, r, i, q] if k] if met.size else []
        on = [names[int(k)] for k in by[: len(kinds), r, i, q]] if kinds else []
        via = points[: len(kinds), r, i, q] if kinds else np.empty((0, 3))
        length = _length(kinds, [faces[name] for name in on], via, transmitter[i], receiver[r])
        letter = {_REFLECTED: "R", _DIFFRACTED: "D"}
        code = "+".join(f"{letter[k]}:{name}" for k, name in zip(kinds, on, strict=True))
        yield (r, i, a[r, 0, i, q], a[r, 1, i, q], length, *(x[r, i, q] for x in angles), code)


def _length(
    kinds: list[int], faces: list[list[tuple[Array, Array]]], via: Array, transmitter: Array, receiver: Array
) -> float:
    """Return a path's length: by images where it is only reflected, since its points have single precision."""
    if all(kind == _REFLECTED for kind in kinds):
        image = transmitter
        for planes, point in zip(faces, via, strict=True):
            on, normal = min(planes, key=lambda face: abs((point - face[0]) @ face[1]))
            image = image - 2.0 * ((image - on) @ normal) * normal
        return float(np.linalg.norm(image - receiver))
    legs = np.diff(np.vstack([transmitter, via, receiver]), axis=0)
    return float(np.linalg.norm(legs, axis=1).sum())


# -- command line --------------------------------------------------------------------------------------------


def main() -> None:
    """Trace and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenario", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--frames", default="0", help="numbers of frames, with commas")
    parser.add_argument("--what", choices=WHAT, default="edges")
    parser.add_argument("--force", action="store_true", help="overwrite tables")
    options = parser.parse_args()
    try:
        site = rf.load_scenario(options.scenario)
        options.output.mkdir(parents=True, exist_ok=True)
        for frame in map(int, options.frames.split(",")):
            path = options.output / f"{options.scenario.stem}_frame{frame}.npz"
            with claim(path, inputs=[options.scenario], force=options.force) as job:
                table = trace(site, frame, options.what)
                job.write(path, _packed(table))
            print(f"{path}: {len(table['rx'])} rays of {len(site.receiver_ids)} x {len(site.transmitter)} links")
    except (RfposeError, OSError, ValueError) as error:
        sys.exit(str(error))


def _packed(table: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **table)
    return buffer.getvalue()


if __name__ == "__main__":
    main()
