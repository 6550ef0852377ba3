"""Print what becomes of poses in a real field: ground, neighbours, tower, the plate behind the antennas.

    python benchmarks/real_field.py ../shared/data/traced                  # the whole table
    python benchmarks/real_field.py ../shared/data/traced --pose rigid     # without the site in the model
    python benchmarks/real_field.py ../shared/data/traced --case 'beside' --json

Propagation is by programs that this project did not write: ray tables by Sionna RT and a receiver's own mirror by NEC-2
(see `benchmarks/traced.py`). Tones of 0.75 and 7.5 MHz, 50 dB; eight mirrors and two suns, so sixteen mirror-frames a
case; pivots as surveyed are 5 mm off, with that sigma; commanded postures 20 mrad off, those of neighbours 5. Errors
are of the mirror normal in mrad; NEES is the mean squared error over the stated covariance, 1 where that is true.
Silent: solved, and the error above its protection level or above 5 sigma. Tables of one's own
(`benchmarks/real_field_tables.py`) and antenna patterns (`scripts/antenna_pattern.py`) are looked for in the folders of
``--tables`` and ``--patterns``; cases that lack theirs are named.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import traced
from traced import SPEED_MPS, Table, antenna_isotropic, lines_of, measured, site_of

import rfpose as rf
from rfpose import geometry
from rfpose.antenna import (
    AntennaPattern,
    MirrorType,
    PostureCarriers,
    components,
    grid_directions,
    learn_pattern,
)
from rfpose.dsp import TonePhases
from rfpose.errors import RfposeError
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import Common
from rfpose.pipeline.choice import choose
from rfpose.pipeline.formats.antenna_file import read_pattern, write_pattern
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.postures import commanded_normals
from rfpose.pipeline.site.field import SiteField, antenna_of
from rfpose.pipeline.solve import solve
from rfpose.propagation import RayKind
from rfpose.scenario import Scenario

__all__ = ["Case", "Folders", "Spec", "case_of", "cases", "posture_table", "specs", "told_normals"]

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

SUNS = (0, 1)
COMMANDED_OFF_RAD = 0.02
PIVOT_OFF_M = 0.005
NEIGHBOUR_OFF_RAD = 0.005
LESSON_OFF_RAD = 0.005
FEWEST_LESSONS = 5
MIRROR_M = 2.0
SEED = 1
RIM = r"D:ground"
"""The ground of the ray tracer ends; rays from its rim are no physics."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Folders:
    """Where tables are: the given ones, one's own, and antenna patterns."""

    given: Path
    own: Path | None = None
    patterns: Path | None = None

    def table(self, variant: str, mhz: float, sun: int) -> Table | None:
        """Return a table, of the given ones first; None where there is none."""
        for folder in (self.given / "paths", self.own):
            path = None if folder is None else folder / f"{variant}_{mhz:.0f}MHz_sun{sun}.npz"
            if path is not None and path.exists():
                return Table.read(path)
        return None

    def moments(self, place: str, mhz: float) -> Path | None:
        """Return the file of responses by moments; None where there is none."""
        path = self.given / "nec" / f"{place}_y_{mhz:.0f}MHz.npz"
        return path if path.exists() else None

    def pattern(self, place: str, mhz: float) -> Path | None:
        """Return the file of an antenna pattern; None where there is none."""
        path = None if self.patterns is None else self.patterns / f"{place}_y_{mhz:.0f}MHz.h5"
        return path if path is not None and path.exists() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Spec:
    """A row of the table: which propagation, what the solver is told of it, and what is wished.

    Attributes
    ----------
    variant
        Of the ray tables; ``moments``: direct rays, by the responses of the receiver's own mirror alone;
        ``everything``: ground, tower and neighbours, diffraction at their edges, and the antenna's pattern.
    through_iq
        Samples are simulated and measured; else lines are summed from the rays and get their noise.
    drop
        Rays whose code matches are left out.
    antenna
        ``isotropic``, or ``plate``: a dipole before its own plate, by moments.
    told
        What the solver is told of the antenna: ``none``; ``given``, the very pattern; ``other mesh``, that of a coarser
        mesh than the truth's, with its errors as they are stated; ``learned``.
    ground
        Factor on the ground's true constants in what the solver is told; None: that there is no ground.
    transmitters
        ``10`` those of Table 2, ``5`` and ``20`` fewer and more, ``high`` all 30 m higher.
    carriers, band_mhz
        So many carriers at each transmitter's antenna, spread evenly over a band.
    target_mrad
        Rms to be reached; None: not stated.
    today
        What the solver of before made of it, as measured then.
    """

    name: str
    mhz: float = 433.0
    place: str
    variant: str
    through_iq: bool = False
    drop: str = RIM
    antenna: str = "isotropic"
    told: str = "none"
    ground: float | None = 1.0
    transmitters: str = "10"
    carriers: int = 1
    band_mhz: float = 0.0
    target_mrad: float | None = None
    today: str = ""


def specs() -> Iterator[Spec]:
    """Yield the rows of the table."""
    for place, factor in (("beside", 1.0), ("front", 2.0)):
        yield Spec(
            name=f"tower, neighbours, no ground; {place}", place=place, variant="field", drop="ground", ground=None,
            target_mrad=0.15 * factor, today="15/16 at 0.0012 by leaving out",
        )  # fmt: skip
        yield Spec(name=f"ground, true constants; {place}", place=place, variant="ground", today="6/8; 0/24")
        yield Spec(
            name=f"ground, constants 30 % off; {place}", place=place, variant="ground", ground=1.3,
            target_mrad=0.5 * factor,
        )  # fmt: skip
        yield Spec(
            name=f"ground, tower, neighbours; {place}", place=place, variant="field", target_mrad=1.3 * factor,
            today="0/24",
        )  # fmt: skip
        if place == "beside":
            yield Spec(
                name="the same through samples; beside", place=place, variant="field", through_iq=True, target_mrad=1.3,
            )  # fmt: skip
        yield Spec(name=f"and own plates as rays; {place}", place=place, variant="plates", target_mrad=5.0 * factor)
        yield Spec(
            name=f"and plates and edges; {place}", place=place, variant="edges", target_mrad=5.0 * factor,
            today="0/16; 0/24",
        )  # fmt: skip
    for mhz, place in ((100.0, "beside"), (100.0, "front"), (433.0, "front"), (433.0, "beside")):
        yield Spec(
            name=f"own plate by moments alone, {mhz:.0f} MHz, pattern given; {place}", mhz=mhz, place=place,
            variant="moments", antenna="plate", told="given", ground=None, target_mrad=0.05, today="0/16",
        )  # fmt: skip
    for mhz, place, targets in (
        (100.0, "beside", (None, None, None)),
        (433.0, "beside", (None, 4.6, 6.0)),
        (433.0, "front", (None, 5.0, 6.5)),
    ):
        if mhz == 433.0:
            yield Spec(
                name=f"everything, {mhz:.0f} MHz, pattern of another mesh; {place}", mhz=mhz, place=place,
                variant="everything", antenna="plate", told="other mesh",
            )  # fmt: skip
        for told, target in zip(("none", "given", "learned"), targets, strict=True):
            yield Spec(
                name=f"everything, {mhz:.0f} MHz, pattern {told}; {place}", mhz=mhz, place=place, variant="everything",
                antenna="plate", told=told, target_mrad=target, today="0",
            )  # fmt: skip
    for transmitters, what, target in (
        ("5", "5 transmitters", None), ("20", "20 transmitters", 3.6), ("high", "transmitters 30 m higher", None),
    ):  # fmt: skip
        yield Spec(
            name=f"everything, {what}, pattern given; beside", place="beside", variant="everything", antenna="plate",
            told="given", transmitters=transmitters, target_mrad=target,
        )  # fmt: skip
    for mhz in (100.0, 433.0, 2400.0):
        yield Spec(
            name=f"isotropic, no own plate, {mhz:.0f} MHz; beside", mhz=mhz, place="beside", variant="everything",
        )  # fmt: skip
    for mhz, carriers, band_mhz in ((433.0, 2, 25.0), (433.0, 4, 25.0), (433.0, 4, 100.0), (2400.0, 2, 80.0),
                                    (2400.0, 4, 80.0), (2400.0, 8, 80.0)):  # fmt: skip
        yield Spec(
            name=f"isotropic, no own plate, {mhz:.0f} MHz, {carriers} carriers over {band_mhz:.0f} MHz; beside",
            mhz=mhz, place="beside", variant="everything", carriers=carriers, band_mhz=band_mhz,
        )  # fmt: skip


# -- cases ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A row of the table as measured, with its truth.

    Attributes
    ----------
    spec
        What it is.
    scenario
        The site as the solver is told it: pivots as surveyed, ground's constants as known.
    tones
        What was measured, a sun a frame.
    normal_true_enu, normal_commanded_enu : (frame, heliostat, xyz)
        Where mirrors point, and where they were told to.
    """

    spec: Spec
    scenario: Scenario
    tones: TonePhases
    normal_true_enu: Array
    normal_commanded_enu: Array

    @property
    def name(self) -> str:
        """What it is, in words."""
        return self.spec.name


def cases(folder: str | Path, *, own: str | Path | None = None, patterns: str | Path | None = None) -> list[Case]:
    """Return the cases of the table whose tables are there.

    Parameters
    ----------
    folder
        ``../shared/data/traced``.
    own, patterns
        Folders of tables and antenna patterns of one's own.
    """
    folders = Folders(
        given=Path(folder),
        own=None if own is None else Path(own),
        patterns=None if patterns is None else Path(patterns),
    )
    found = [case_of(spec, folders) for spec in specs()]
    return [case for case in found if not isinstance(case, str)]


def case_of(spec: Spec, folders: Folders, suns: Sequence[int] = SUNS) -> Case | str:
    """Return a case, or what it lacks; suns past the second need tables of one's own."""
    truth = _true_site(spec)
    normal = traced.normals_enu(truth, suns)
    n_heliostat = len(truth.heliostat)
    lines = []
    for frame, sun in enumerate(suns):
        rot = geometry.rot_enu_from_mirror(normal[frame, :n_heliostat])
        found = _lines(spec, folders, truth, sun, rot)
        if isinstance(found, str):
            return found
        lines.append(found)
    told = _told_site(spec, truth)
    if spec.told != "none":
        pattern = _told_pattern(spec, folders)
        if isinstance(pattern, str):
            return pattern
        told = told.changed(antenna={"pattern": str(pattern)})
    if spec.through_iq:
        tones = _tones_through_iq(spec, folders, truth)
    else:
        tones = measured(truth, np.stack(lines), seed=SEED)
    rng = np.random.default_rng([SEED, 2])
    off = np.full(normal.shape[1], NEIGHBOUR_OFF_RAD)
    off[:n_heliostat] = COMMANDED_OFF_RAD
    commanded = _tilted(normal, off, rng)
    return Case(
        spec=spec,
        scenario=told.changed(posture={"csv": str(posture_table(truth, commanded))}),
        tones=tones,
        normal_true_enu=normal[:, :n_heliostat],
        normal_commanded_enu=commanded[:, :n_heliostat],
    )


def _learned_pattern(spec: Spec, folders: Folders) -> Path | str:
    """Learn the pattern from other postures than the case's, believed to 5 mrad, and return its file."""
    suns = [sun for sun in range(len(SUNS), 50) if folders.table("open", spec.mhz, sun) is not None]
    if len(suns) < FEWEST_LESSONS:
        return f"no {FEWEST_LESSONS} tables open_{spec.mhz:.0f}MHz_sun2 and on, to learn from"
    told = Path(_SCRATCH.name) / f"learned_{spec.place}_{spec.mhz:.0f}MHz.h5"
    if told.exists():
        return told
    lessons = case_of(replace(spec, told="given"), folders, suns)
    if isinstance(lessons, str):
        return lessons
    site, (group,) = lessons.scenario, mirror_groups(lessons.scenario)
    n_posture = len(suns) * len(site.heliostat)
    rng = np.random.default_rng([SEED, 3])
    believed = commanded_normals(site, np.full(len(suns), np.nan))
    lesson_rad = np.full(len(site.heliostat), LESSON_OFF_RAD)
    believed[:, : len(site.heliostat)] = _tilted(lessons.normal_true_enu, lesson_rad, rng)
    rot = geometry.rot_enu_from_mirror(believed)
    own_rot = rot[:, : len(site.heliostat)].reshape(-1, 3, 3)
    pivot = np.tile(group.pivot_enu_m, (len(suns), 1))
    # the pattern holds the own plate: whichever it is, no such rays are foreseen
    foreseen = SiteField(site, group, rot, antenna_of(site))(
        pivot,
        own_rot,
        Common(floor=0.05, tail=3.0, factor_scale=np.ones(len(RayKind)), soil_change=0j, soil_sigma=(0.0, 0.0)),
    )
    learned = learn_pattern(
        PostureCarriers(
            amplitude=group.of_mirrors(lessons.tones.carrier),
            rays=foreseen.rays,
            pivot_enu_m=pivot,
            rot_enu_from_mirror=own_rot,
            wavelength_m=SPEED_MPS / site.carrier_rf_hz,
            rotation_sigma_rad=LESSON_OFF_RAD / np.sqrt(2.0),
            pivot_sigma_m=PIVOT_OFF_M,
        ),
        MirrorType(
            receiver_mirror_m=group.places_m[0], axis_mirror=np.array([0.0, 1.0, 0.0]), plate_m=(MIRROR_M, MIRROR_M)
        ),
        frequency_hz=site.radio.centre_frequency_hz,
    )
    print(f"learned {spec.place}, {spec.mhz:.0f} MHz: {n_posture} postures; {learned.report()}", file=sys.stderr)
    write_pattern(told, learned.pattern)
    return told


def _tones_through_iq(spec: Spec, folders: Folders, truth: Scenario) -> TonePhases:
    """Simulate samples from the tables, and measure them."""
    azimuth, elevation = zip(*(traced.sun_deg(sun) for sun in SUNS), strict=True)
    site = truth.changed(
        simulation={
            "frame_count": len(SUNS),
            "frame_interval_s": 60.0,
            "sun_azimuth_deg": azimuth,
            "sun_elevation_deg": elevation,
            "paths": [str(folders.given / "paths" / f"{spec.variant}_{spec.mhz:.0f}MHz_sun{sun}.npz") for sun in SUNS],
            "paths_without": ["D:ground"],
            "reference_range_m": traced.REFERENCE_M,
            "tone_snr_db": traced.SNR_DB,
            "sample_format": "complex64",
        }
    )
    return rf.process(rf.simulate(site, seed=SEED), estimator="correlator", pose="independent").tones


def _true_pattern(spec: Spec, path: Path) -> AntennaPattern:
    """Return the pattern that waves meet: that of the file, or that of its plate with a finer mesh."""
    pattern = read_pattern(path).pattern
    if spec.told != "other mesh":
        return pattern
    # the finer mesh is of one frequency and another grid: what it changes there, it changes all about
    finer = read_pattern(path.with_name(f"{path.stem}_40cells.h5")).pattern
    n_polar, n_azimuth = pattern.response.shape[2:4]
    direction = grid_directions(n_polar, n_azimuth).reshape(-1, 3)
    tables = [p.table(float(finer.frequency_hz[0])) for p in (finer, pattern)]
    change = np.stack(
        [tables[0].vector(direction, r) - tables[1].vector(direction, r) for r in range(pattern.n_receiver)]
    )
    moved = components(change.reshape(pattern.n_receiver, n_polar, n_azimuth, 3))
    return replace(pattern, response=pattern.response + moved)


def _told_pattern(spec: Spec, folders: Folders) -> Path | str:
    """Return the file that the solver is told, or what is missing."""
    path = folders.pattern(spec.place, spec.mhz)
    if path is None:
        return f"no pattern {spec.place}_y_{spec.mhz:.0f}MHz"
    if spec.told == "other mesh":
        return path
    if spec.told == "learned":
        return _learned_pattern(spec, folders)
    # the truth is of the same mesh: what that mesh is off by is no error here
    exact = read_pattern(path).pattern
    told = Path(_SCRATCH.name) / f"exact_{path.name}"
    write_pattern(told, replace(exact, sigma=np.zeros(exact.sigma.shape)), force=True)
    return told


# what a table holds: the tracer finds edges by rays that hit beside them, so those of towers and few of far plates; and
# its coefficients of diffraction are its own
_TRACED: dict[str, dict[str, Any]] = {
    "ground": {"foresee": ["ground"]},
    "moments": {"foresee": []},
    "field": {"foresee": ["ground", "specular"]},
    "plates": {"foresee": ["ground", "specular", "own_plate"]},
    "edges": {
        "foresee": ["ground", "specular", "diffracted", "own_plate"], "edges": "boxes", "wedge": "sionna",
    },
}  # fmt: skip


_SCRATCH = tempfile.TemporaryDirectory(prefix="rfpose-real-field-")


def told_normals(case: Case) -> Array:
    """Return where all mirrors of a case were told to point (frame, mirror, xyz), neighbours last."""
    return commanded_normals(case.scenario, np.full(len(case.normal_true_enu), np.nan))


def posture_table(site: Scenario, normal: Array) -> Path:
    """Write where mirrors were told to point (frame, mirror, xyz), as ``[posture] csv`` has it."""
    names = [mirror.id for mirror in (*site.heliostat, *site.site.structures.plate)]
    lines = ["id,frame,normal_e,normal_n,normal_u"]
    for frame, normals in enumerate(normal):
        lines += [",".join([name, str(frame), *map(repr, n)]) for name, n in zip(names, normals.tolist(), strict=True)]
    handle, path = tempfile.mkstemp(suffix=".csv", dir=_SCRATCH.name)
    with open(handle, "w") as file:
        file.write("\n".join(lines) + "\n")
    return Path(path)


def _true_site(spec: Spec) -> Scenario:
    place_m = None if spec.transmitters == "10" else traced.TRANSMITTERS_ENU_M[spec.transmitters]
    site = site_of(1e6 * spec.mhz, spec.place, transmitter_enu_m=place_m)
    if spec.carriers == 1:
        return site
    # steps that differ by some kilohertz, or lines of one step would fall on those of another
    step = 1e6 * spec.band_mhz * (np.arange(spec.carriers) / (spec.carriers - 1) - 0.5) + 3e3 * np.arange(spec.carriers)
    rate_hz = 2.2e6 * spec.band_mhz + 40e6
    return site.changed(
        radio={"sample_rate_hz": rate_hz, "frame_samples": round(2.5e-3 * rate_hz)},
        transmitter=[
            {"id": f"{t.id}_{k}", "position_enu_m": t.position_enu_m, "carrier_hz": round(t.carrier_hz + hz)}
            | ({"mast": f"{t.id}_0"} if k else {})
            for t in site.transmitter
            for k, hz in enumerate(step.tolist())
        ],
    )


def _told_site(spec: Spec, truth: Scenario) -> Scenario:
    """Return the site as surveyed: pivots off, ground's constants off, and no more structures than there are."""
    off = PIVOT_OFF_M * np.random.default_rng([SEED, 1]).standard_normal(truth.pivot_enu_m.shape)
    # where rays were traced without the plates of the receivers' own mirrors, mirrors have none
    has_plate = spec.antenna == "plate" or spec.variant in ("plates", "edges")
    size = {} if has_plate else {"width_m": None, "height_m": None}
    told = truth.changed(
        heliostat=[
            h.changed(**size, pivot_enu_m=tuple(p))
            for h, p in zip(truth.heliostat, (truth.pivot_enu_m + off).tolist(), strict=True)
        ]
    )
    if spec.variant in ("ground", "moments"):
        told = told.changed(site={"structures": None})
    told = told.changed(multipath=_TRACED.get(spec.variant, _TRACED["edges"]))
    if spec.antenna == "plate" and spec.told == "none":
        told = told.changed(antenna={"receiver": "dipole"})
    if spec.ground is None:
        return told
    permittivity, conductivity = traced.soil(1e6 * spec.mhz)
    return told.changed(
        reflection={
            "model": "fresnel",
            "permittivity": permittivity * spec.ground,
            "conductivity_s_per_m": conductivity * spec.ground,
        }
    )


def _tilted(normal: Array, angle_rad: Array, rng: np.random.Generator) -> Array:
    """Return normals (frame, mirror, xyz) turned by angles (mirror,), each to a side of its own."""
    aside = np.cross(normal, geometry.unit(rng.standard_normal(normal.shape)))
    return geometry.unit(normal + np.tan(angle_rad)[:, None] * geometry.unit(aside))


def _lines(spec: Spec, folders: Folders, site: Scenario, sun: int, rot: Array) -> Complex | str:
    """Return (receiver, transmitter, line) of one sun, or what is missing."""
    if spec.variant == "moments":
        return _lines_by_moments(spec, folders, site, sun, rot)
    table = _table(spec, folders, sun)
    if isinstance(table, str):
        return table
    table = table.without(spec.drop).at(site, spec.place)
    if spec.transmitters == "5":
        table = table.from_transmitters(traced.FIVE)
    table = table.of_carriers(spec.carriers)
    if spec.antenna == "isotropic":
        return lines_of(site, table, antenna_isotropic(table, rot))
    pattern = folders.pattern(spec.place, spec.mhz)
    if pattern is None:
        return f"no pattern {spec.place}_y_{spec.mhz:.0f}MHz"
    return lines_of(site, table, traced.antenna_before_plate(site, table, rot, _true_pattern(spec, pattern)))


def _table(spec: Spec, folders: Folders, sun: int) -> Table | str:
    set_of = {"5": "", "10": ""}.get(spec.transmitters, f"-{spec.transmitters}")
    if spec.variant != "everything":
        table = folders.table(spec.variant + set_of, spec.mhz, sun)
        return f"no table {spec.variant}{set_of}_{spec.mhz:.0f}MHz_sun{sun}" if table is None else table
    # traced without the plates of the receivers' own mirrors; else put together: rays that they hide are in `field`
    whole = folders.table("open" + set_of, spec.mhz, sun)
    if whole is not None:
        return whole
    field, edges = (folders.table(name + set_of, spec.mhz, sun) for name in ("field", "edges"))
    if field is None or edges is None:
        return f"no table open{set_of}_{spec.mhz:.0f}MHz_sun{sun}, nor field and edges"
    diffracted = np.array(["D:" in str(code) for code in edges.code])
    return field.and_rays_of(edges.only(diffracted & ~edges.meets_own_plate()))


def _lines_by_moments(spec: Spec, folders: Folders, site: Scenario, sun: int, rot: Array) -> Complex | str:
    """Return the lines of direct rays alone, received before the mirror's own plate."""
    path = folders.moments(spec.place, spec.mhz)
    if path is None and folders.pattern(spec.place, spec.mhz) is not None:
        return _lines(replace(spec, variant="direct"), folders, site, sun, rot)
    if path is None:
        return f"no responses {spec.place}_y_{spec.mhz:.0f}MHz"
    with np.load(path, allow_pickle=False) as file:
        response, centre_hz = file["response"][:, sun, :, :, :, 0], 1e6 * file["freqs"]
        response = response / np.linalg.norm(file["free"])
    rows = [site.receiver_rows(i) for i in range(len(site.heliostat))]
    receiver = traced.receivers_enu_m(site, rot)
    ray = site.transmitter_enu_m - receiver[:, None]
    distance = np.linalg.norm(ray, axis=-1)
    theta = traced.theta_hat(ray / distance[..., None])
    rf_hz = site.radio.centre_frequency_hz + site.line_hz
    weight = traced.quadratic(rf_hz, centre_hz)
    gain = np.ones((*distance.shape, site.line_hz.shape[1]), np.complex128)
    for i, slab in enumerate(rows):
        toward = np.einsum("rtx,xm->rtm", ray[slab] / distance[slab, :, None], rot[i])
        polarised = np.einsum("rtx,xm->rtm", theta[slab], rot[i])
        own = np.stack([(unit * polarised).sum(-1) for unit in traced.spherical_units(toward)], axis=-1)
        gain[slab] = np.einsum("ftl,frtp,rtp->rtl", weight, response[:, i], own)
    turns = rf_hz * distance[..., None] / SPEED_MPS
    return np.asarray(gain * traced.REFERENCE_M / distance[..., None] * np.exp(-2j * np.pi * turns))


# -- the table -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What came of a case."""

    name: str
    solved: int
    of: int
    rms_mrad: float
    median_mrad: float
    max_mrad: float
    nees: float
    within_3_sigma: float
    silent: int
    target_mrad: float | None
    met: bool | None
    today: str
    reasons: dict[str, int]


def row_of(case: Case, result: Result) -> Row:
    """Compare a result with a case's truth."""
    poses = result.poses
    solved = poses.status == PoseStatus.OK
    error = geometry.angle_between_rad(poses.normal_enu, case.normal_true_enu)
    squared = _normalised(poses.normal_enu - case.normal_true_enu, poses.cov_enu, case.normal_true_enu)
    level = np.full(error.shape, np.inf)
    if result.integrity is not None:
        level = result.integrity.protection_level_rad
    with np.errstate(invalid="ignore"):
        silent = solved & ((error > level) | (squared > 25.0))
    mrad = 1e3 * error[solved]
    rms = float(np.sqrt(np.mean(mrad**2))) if mrad.size else np.nan
    nees = float(np.mean(squared[solved]) / 2.0) if mrad.size else np.nan
    enough = bool(solved.mean() >= 0.95 and not silent.any() and 0.5 <= nees <= 1.5)
    target = case.spec.target_mrad
    status, count = np.unique(poses.status[~solved], return_counts=True)
    return Row(
        name=case.name,
        solved=int(solved.sum()),
        of=solved.size,
        rms_mrad=rms,
        median_mrad=float(np.median(mrad)) if mrad.size else np.nan,
        max_mrad=float(mrad.max()) if mrad.size else np.nan,
        nees=nees,
        within_3_sigma=float(np.mean(squared[solved] <= 11.83)) if mrad.size else np.nan,
        silent=int(silent.sum()),
        target_mrad=target,
        met=None if target is None else enough and rms <= target,
        today=case.spec.today,
        reasons={PoseStatus(s).reason: int(n) for s, n in zip(status, count, strict=True)},
    )


def _normalised(off: Array, cov: Array, normal: Array) -> Array:
    """(frame, heliostat) squared error over covariance, of the two angles across the normal."""
    across = geometry.rot_enu_from_mirror(normal)[..., :2]
    two = np.einsum("fhxa,fhx->fha", across, off)
    spread = np.einsum("fhxa,fhxy,fhyb->fhab", across, cov, across)
    known = np.isfinite(spread).all(axis=(-2, -1)) & np.isfinite(two).all(axis=-1)
    spread = np.where(known[..., None, None], spread, np.eye(2))
    squared = np.einsum("fha,fhab,fhb->fh", two, np.linalg.inv(spread), two)
    return np.where(known, squared, np.nan)


def run(case: Case, pose: str) -> Row | str:
    """Solve a case; or say why that was refused."""
    rate = case.scenario.radio.sample_rate
    try:
        choice = choose(case.scenario, pose=pose)
        return row_of(
            case, solve(case.tones, case.scenario, choice, sample_rate=rate, settings={"estimator": "correlator"})
        )
    except RfposeError as error:
        return str(error)


def _printed(row: Row) -> str:
    numbers = " / ".join(f"{x:.3g}" for x in (row.rms_mrad, row.median_mrad, row.max_mrad))
    target = "" if row.target_mrad is None else f"{row.target_mrad:g}"
    met = {None: "", True: "yes", False: "NO"}[row.met]
    return (
        f"| {row.name} | {row.solved}/{row.of} | {numbers} | {row.nees:.2f} | {100 * row.within_3_sigma:.0f} % "
        f"| {row.silent} | {target} | {met} | {row.today} |"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="tables and responses: ../shared/data/traced")
    parser.add_argument("--tables", type=Path, help="ray tables of one's own")
    parser.add_argument("--patterns", type=Path, help="antenna patterns")
    parser.add_argument("--pose", default="site")
    parser.add_argument("--case", default="", help="only cases whose name matches")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    folders = Folders(given=options.folder, own=options.tables, patterns=options.patterns)
    if not (options.folder / "paths").is_dir():
        sys.exit(f"{options.folder}: no folder of traced fields (it has no `paths`); give ../shared/data/traced")
    report: list[dict[str, Any]] = []
    if not options.json:
        print("| case | solved | rms / median / max mrad | NEES | within 3 sigma | silent | target | met | before |")
        print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for spec in specs():
        if re.search(options.case, spec.name) is None:
            continue
        case = case_of(spec, folders)
        row = case if isinstance(case, str) else run(case, options.pose)
        if isinstance(row, str):
            report.append({"name": spec.name, "missing": row})
        else:
            report.append({name: getattr(row, name) for name in Row.__dataclass_fields__})
        if not options.json:
            print(f"| {spec.name} | {row} |" if isinstance(row, str) else _printed(row), flush=True)
    if options.json:
        print(json.dumps({"pose": options.pose, "cases": report}, indent=1))


if __name__ == "__main__":
    main()
