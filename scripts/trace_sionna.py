"""Trace the rays of a site by Sionna RT, and write ray tables (docs/ray-tables.md) for `rfpose simulate`.

    python scripts/trace_sionna.py site.toml surroundings.toml -o tables/ --frames 0,1

writes ``tables/site_frame0.npz`` and so on: the rays from every transmitter to every receiver of the scenario, in the
postures that its ``[simulation]`` gives a frame. ``--what`` leaves things out: ``direct`` alone, ``ground`` too,
``field`` (boxes and plates, too), ``plates`` (and the mirrors' own), ``edges`` (and first-order diffraction), ``open``
(edges, without the plates of mirrors that carry receivers: what to weigh with patterns that hold the own plate).

Needs the extra ``trace`` (Sionna RT) and LLVM 19: Debian's package ``libllvm19``; elsewhere DRJIT_LIBLLVM_PATH names
the library. The surroundings:

    mirror_m = [2.0, 2.0]            # width and height of the heliostats' plates
    [ground]                         # without it no ground
    permittivity = 15.0
    conductivity_s_per_m = 0.009
    [[box]]                          # upright, its sides to the east and north
    id = "tower"
    base_enu_m = [0.0, 0.0, 0.0]
    size_m = [6.0, 6.0, 46.0]
    permittivity = 5.24
    conductivity_s_per_m = 0.024
    [[plate]]                        # of metal, as wide and high as the mirrors
    id = "H01n0"
    centre_enu_m = [20.0, 4.8, 2.0]
    normal_enu = [0.0, 0.0, 1.0]     # without it, it sends the sun to the aim point as heliostats do

Amplitudes hold λ/4πd and no propagation phase. Lengths are exact: image rays' by images in double precision, diffracted
ones' along their points. What ray tracing cannot tell is said in docs/ray-tables.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import rfpose as rf
from rfpose import geometry
from rfpose.errors import RfposeError
from rfpose.files import claim

Array = npt.NDArray[np.float64]

WHAT = ("direct", "ground", "field", "plates", "edges", "open")
SPEED_MPS = 299_792_458.0
GROUND, RIM = "ground", "D:ground"
GROUND_HALF_WIDTH_M = 2000.0
THICK_M = 1000.0
"""Materials are slabs to Sionna RT; a half-space is one that nothing comes back from."""
BASE_M = 0.01
"""Boxes begin so far above the ground, where faces would coincide."""
SAMPLES = {"direct": 100_000, "ground": 100_000}
_METAL = (1.0, 1e7)
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
    return Thing(name, corners, [(0, 1, 2), (0, 2, 3)], _METAL, [(centre, rot[:, 2])])


def box(name: str, base: Array, size: Array, material: tuple[float, float]) -> Thing:
    """Return an upright box."""
    ring = 0.5 * size[:2] * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corners = [base + np.array([x, y, z]) for z in (BASE_M, size[2]) for x, y in ring]
    triangles = [(4, 5, 6), (4, 6, 7)]
    for a in range(4):
        b = (a + 1) % 4
        triangles += [(a, b, b + 4), (a, b + 4, a + 4)]
    faces = [(base + 0.5 * s * size[k] * np.eye(3)[k], np.eye(3)[k]) for k in (0, 1) for s in (-1.0, 1.0)]
    return Thing(name, np.array(corners), triangles, material, [*faces, (base + size * np.eye(3)[2], np.eye(3)[2])])


def level_ground(material: tuple[float, float]) -> Thing:
    """Return the ground, wide enough for its rim to be far."""
    w = GROUND_HALF_WIDTH_M
    corners = np.array([(-w, -w, 0), (w, -w, 0), (w, w, 0), (-w, w, 0)], np.float64)
    return Thing(GROUND, corners, [(0, 1, 2), (0, 2, 3)], material, [(np.zeros(3), np.eye(3)[2])])


def things_of(site: rf.Scenario, around: dict[str, Any], normals: dict[str, Array], what: str) -> list[Thing]:
    """Return what stands on a site; ``normals`` are those of heliostats and plates by name."""
    found: list[Thing] = []
    if what == "direct":
        return found
    if "ground" in around:
        found.append(level_ground(_material(around["ground"])))
    if what == "ground":
        return found
    for one in around.get("box", []):
        found.append(box(one["id"], np.array(one["base_enu_m"]), np.array(one["size_m"]), _material(one)))
    standing = {one["id"]: np.array(one["centre_enu_m"]) for one in around.get("plate", [])}
    if what in ("plates", "edges"):
        for heliostat in site.heliostat:
            standing[heliostat.id] = np.array(heliostat.pivot_enu_m) + heliostat.arm_m * normals[heliostat.id]
    for name, centre in standing.items():
        found.append(plate(name, centre, geometry.rot_enu_from_mirror(normals[name]), around["mirror_m"]))
    return found


def _material(table: dict[str, Any]) -> tuple[float, float]:
    return float(table["permittivity"]), float(table.get("conductivity_s_per_m", 0.0))


def normals_by_name(site: rf.Scenario, around: dict[str, Any], truth: Any, frame: int) -> dict[str, Array]:
    """Return the normals of heliostats and plates in a frame."""
    found = dict(zip(site.heliostat_ids, truth.normal_enu[frame], strict=True))
    plates = around.get("plate", [])
    moving = [one for one in plates if "normal_enu" not in one]
    found |= {one["id"]: geometry.unit(one["normal_enu"]) for one in plates if "normal_enu" in one}
    if moving:
        # what heliostats without receivers do is what the simulator has heliostats do
        field_ = site.with_field([one["centre_enu_m"] for one in moving], ids=[one["id"] for one in moving])
        normal = rf.simulate(field_, seed=0).truth.normal_enu[frame]
        found |= dict(zip((one["id"] for one in moving), normal, strict=True))
    return found


# -- Sionna RT -----------------------------------------------------------------------------------------------


def trace(site: rf.Scenario, around: dict[str, Any], frame: int, what: str = "edges") -> dict[str, Any]:
    """Return the columns of a ray table; a row a ray."""
    truth = rf.simulate(site, seed=0).truth
    receiver = truth.receiver_enu_m[frame]
    things = things_of(site, around, normals_by_name(site, around, truth, frame), what)
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
            material = RadioMaterial(
                f"m{k}", thickness=THICK_M, relative_permittivity=thing.material[0], conductivity=thing.material[1]
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
        samples_per_src=SAMPLES.get(what, 300_000),
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
    parser.add_argument("surroundings", type=Path, nargs="?", help="TOML of what stands there; default: nothing")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--frames", default="0", help="numbers of frames, with commas")
    parser.add_argument("--what", choices=WHAT, default="edges")
    parser.add_argument("--force", action="store_true", help="overwrite tables")
    options = parser.parse_args()
    try:
        site = rf.load_scenario(options.scenario)
        around = {} if options.surroundings is None else tomllib.loads(options.surroundings.read_text())
        options.output.mkdir(parents=True, exist_ok=True)
        for frame in map(int, options.frames.split(",")):
            path = options.output / f"{options.scenario.stem}_frame{frame}.npz"
            with claim(path, inputs=[options.scenario], force=options.force) as job:
                table = trace(site, around, frame, options.what)
                job.write(path, _packed(table))
            print(f"{path}: {len(table['rx'])} rays of {len(site.receiver_ids)} x {len(site.transmitter)} links")
    except (RfposeError, OSError, tomllib.TOMLDecodeError, KeyError) as error:
        sys.exit(f"{error!r}" if isinstance(error, KeyError) else str(error))


def _packed(table: dict[str, Any]) -> bytes:
    import io

    buffer = io.BytesIO()
    np.savez_compressed(buffer, **table)
    return buffer.getvalue()


if __name__ == "__main__":
    main()
