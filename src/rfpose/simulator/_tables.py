"""Ray tables: the ways of waves as a propagation program found them, in place of those from geometry."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import RecordingError, ScenarioError
from rfpose.foreign import beside, read_arrays
from rfpose.scenario import SPEED_OF_LIGHT_MPS, Scenario
from rfpose.simulator._paths import Paths

__all__ = ["RayTable", "SiteTables", "read_table"]

ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]

_MAX_LENGTH_M, _MAX_FIELD = 1e7, 1e3
SAME_PLACE_M = 1e-3
"""A receiver or transmitter of a table that is farther from where the scenario has it is another one."""
_PER_RAY = {
    "rx": "iu",
    "tx": "iu",
    "a_theta": "fc",
    "a_phi": "fc",
    "length_m": "f",
    "theta_t": "f",
    "theta_r": "f",
    "phi_r": "f",
    "code": "U",
}
_OTHERS = {"rx_names": "U", "rx_enu_m": "f", "tx_enu_m": "f", "frequency_hz": "iuf"}
_REMEDY = "make it anew as docs/ray-tables.md has it (scripts/trace_sionna.py does)"


@dataclass(frozen=True, slots=True, kw_only=True)
class RayTable:
    """All rays of a site in one posture, a row a ray; see docs/ray-tables.md.

    Attributes
    ----------
    path
        The file, for messages.
    rx, tx : (ray,)
        Rows of ``rx_names`` and ``tx_enu_m``.
    a_theta, a_phi : (ray,)
        Field at the receiver over its unit vectors of θ and φ, λ/4πd in it, the phase of the length not.
    length_m : (ray,)
        [m].
    theta_r, phi_r : (ray,)
        Where it comes from: angle from up, angle from east to north [rad].
    code : (ray,)
        What it met, in order from the transmitter: ``R:ground+D:tower``; empty: nothing.
    rx_names, rx_enu_m : (receiver,), (receiver, xyz)
        [m].
    tx_enu_m : (transmitter, xyz)
        [m].
    frequency_hz
        At which amplitudes hold.
    """

    path: Path
    rx: IntArray
    tx: IntArray
    a_theta: ComplexArray
    a_phi: ComplexArray
    length_m: FloatArray
    theta_r: FloatArray
    phi_r: FloatArray
    code: npt.NDArray[np.str_]
    rx_names: npt.NDArray[np.str_]
    rx_enu_m: FloatArray
    tx_enu_m: FloatArray
    frequency_hz: float


def read_table(path: Path) -> RayTable:
    """Read and check a ray table.

    Raises
    ------
    RecordingError
        The file is missing or damaged, an array is missing or of another kind or shape, a value is not finite or
        points to no receiver or transmitter; the message names array and row.
    """
    kinds = _PER_RAY | _OTHERS
    found = read_arrays(path, kinds, remedy=_REMEDY)
    n_ray, n_rx, n_tx = len(np.atleast_1d(found["rx"])), found["rx_names"].size, len(np.atleast_1d(found["tx_enu_m"]))
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_PER_RAY, (n_ray,))
    shapes |= {"rx_names": (n_rx,), "rx_enu_m": (n_rx, 3), "tx_enu_m": (n_tx, 3), "frequency_hz": ()}
    for name, array in found.items():
        if array.dtype.kind not in kinds[name]:
            raise RecordingError(f"{path}: array `{name}` holds {array.dtype}, which it cannot be; {_REMEDY}")
        if array.shape != shapes[name]:
            raise RecordingError(f"{path}: array `{name}` must have shape {shapes[name]}, got {array.shape}; {_REMEDY}")
        if array.dtype.kind in "fc":
            _refuse_rows(path, name, array, ~np.isfinite(array), "not finite")
    for name, n in (("rx", n_rx), ("tx", n_tx)):
        _refuse_rows(path, name, found[name], (found[name] < 0) | (found[name] >= n), f"none of the {n} there are")
    for name, low, high in (
        ("length_m", 0.0, _MAX_LENGTH_M),
        ("a_theta", -1.0, _MAX_FIELD),
        ("a_phi", -1.0, _MAX_FIELD),
    ):
        size = np.abs(found[name]) if low < 0.0 else found[name]
        _refuse_rows(path, name, found[name], (size <= low) | (size > high), f"beyond what a ray can have ({high:g})")
    if not found["frequency_hz"] > 0.0:
        raise RecordingError(f"{path}: `frequency_hz` must be above zero, got {found['frequency_hz']}; {_REMEDY}")
    wide = {"i": np.int64, "u": np.int64, "f": np.float64, "c": np.complex128}
    columns: dict[str, Any] = {k: v.astype(wide[v.dtype.kind]) if v.dtype.kind in wide else v for k, v in found.items()}
    for name in ("a_theta", "a_phi"):
        columns[name] = columns[name].astype(np.complex128)
    columns["frequency_hz"] = float(columns["frequency_hz"])
    del columns["theta_t"]  # what transmitters' antennas do is in the amplitudes
    return RayTable(path=path, **columns)


def _refuse_rows(path: Path, name: str, array: npt.NDArray[Any], bad: npt.NDArray[np.bool_], why: str) -> None:
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise RecordingError(f"{path}: `{name}` in row {where[0]} is {array[where]}, {why}; {_REMEDY}")


# -- a site's tables -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """A table's rays in the order of a scenario's links: those of link l are ``first[l]`` up to ``first[l + 1]``."""

    first: IntArray
    length_m: FloatArray
    gain: ComplexArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteTables:
    """The rays of a whole run.

    Attributes
    ----------
    files
        Of the tables.
    receiver_enu_m : (frame, receiver, xyz)
        Where the tables have the receivers [m].
    """

    files: tuple[Path, ...]
    receiver_enu_m: FloatArray
    _scenario: Scenario
    _columns: tuple[_Columns, ...]

    @classmethod
    def of(
        cls, scenario: Scenario, normal_enu: FloatArray, position_enu_m: FloatArray, folder: Path | None
    ) -> SiteTables | None:
        """Return the tables that a scenario names; None where it names none.

        Parameters
        ----------
        scenario
        normal_enu, position_enu_m : (frame, heliostat, xyz), (frame, receiver, xyz)
            Where the scenario has mirrors pointing, and the receivers [m].
        folder
            Where relative names are looked for first; then from where the program runs.

        Raises
        ------
        RecordingError
            As `read_table`.
        ScenarioError
            A table is of another site, posture or band.
        """
        named = scenario.simulation.paths
        if named is None:
            return None
        names = (named,) if isinstance(named, str) else named
        files = tuple(beside(name, folder) for name in names)
        columns: list[_Columns] = []
        places = np.empty(position_enu_m.shape)
        tables: dict[Path, RayTable] = {}
        for i_frame, (position, normal) in enumerate(zip(position_enu_m, normal_enu, strict=True)):
            path = files[i_frame if len(files) > 1 else 0]
            if path not in tables:
                tables = {path: read_table(path)}
            table = tables[path]
            rows = _receiver_rows(table, scenario, position, i_frame)
            places[i_frame] = table.rx_enu_m[rows]
            if i_frame < len(files):
                columns.append(_in_order(table, scenario, rows, _transmitter_rows(table, scenario), normal))
        return cls(files=files, receiver_enu_m=places, _scenario=scenario, _columns=tuple(columns))

    def paths(self, i_frame: int) -> Paths:
        """Return a frame's rays."""
        columns = self._columns[i_frame if len(self._columns) > 1 else 0]
        link = np.repeat(np.arange(len(columns.first) - 1), np.diff(columns.first))
        within = np.arange(len(link)) - columns.first[link]
        shape = (self.receiver_enu_m.shape[1], len(self._scenario.transmitter))
        n_ray = max(1, int(np.diff(columns.first).max()))
        length, gain = np.zeros((*shape, n_ray)), np.zeros((*shape, n_ray), np.complex128)
        length.reshape(-1, n_ray)[link, within] = columns.length_m
        gain.reshape(-1, n_ray)[link, within] = columns.gain
        turns = self._scenario.carrier_rf_hz[:, None] * length / self._scenario.radio.propagation_speed_mps
        return Paths(length_m=length, gain=gain, signal=np.abs(np.sum(gain * np.exp(-2j * np.pi * turns), axis=-1)))


def _receiver_rows(table: RayTable, scenario: Scenario, position_enu_m: FloatArray, i_frame: int) -> IntArray:
    """Return the table's row of each receiver of the scenario."""
    rows_of: dict[str, list[int]] = {}
    for k, name in enumerate(map(str, table.rx_names)):
        rows_of.setdefault(name.rpartition(":")[2], []).append(k)
    found = np.empty(len(position_enu_m), np.int64)
    for r, (name, place) in enumerate(zip(scenario.receiver_ids, position_enu_m, strict=True)):
        rows = rows_of.get(name)
        if rows is None:
            raise ScenarioError(
                f"{table.path}: has no receiver `{name}`; it has {_listed(table.rx_names)}; trace it for this "
                "scenario, or name the receivers alike (`receiver_ids`)"
            )
        distance = np.linalg.norm(table.rx_enu_m[rows] - place, axis=1)
        found[r] = rows[int(np.argmin(distance))]
        if distance.min() > SAME_PLACE_M:
            raise ScenarioError(
                f"{table.path}: receiver `{name}` stands {distance.min():.4g} m from where the scenario has it in "
                f"frame {i_frame}; trace it for this posture, or correct postures and places in the scenario"
            )
    return found


def _transmitter_rows(table: RayTable, scenario: Scenario) -> IntArray:
    """Return the table's row of each transmitter of the scenario; the table may have more."""
    apart = np.linalg.norm(scenario.transmitter_enu_m[:, None] - table.tx_enu_m, axis=-1)
    if apart.shape[1] == 0 or apart.min(axis=1).max() > SAME_PLACE_M:
        i = int(np.argmax(apart.min(axis=1))) if apart.shape[1] else 0
        far = f"the nearest is {apart[i].min():.4g} m away" if apart.shape[1] else "it has none"
        raise ScenarioError(
            f"{table.path}: has no transmitter where the scenario has `{scenario.transmitter_ids[i]}`: {far}; trace it "
            "for this scenario, or correct `position_enu_m`"
        )
    return np.asarray(apart.argmin(axis=1))


def _listed(names: Sequence[str] | npt.NDArray[np.str_]) -> str:
    return ", ".join(f"{str(name)!r:.40}" for name in names[:5]) + (", …" if len(names) > 5 else "")


def _in_order(
    table: RayTable, scenario: Scenario, receiver_rows: IntArray, transmitter_rows: IntArray, normal_enu: FloatArray
) -> _Columns:
    """Return a table's rays as the scenario numbers links, without those it leaves out, as its antennas get them."""
    _check_frequency(table, scenario)
    link = np.full((len(table.rx_names), len(table.tx_enu_m)), -1)
    link[np.ix_(receiver_rows, transmitter_rows)] = np.arange(len(receiver_rows) * len(transmitter_rows)).reshape(
        len(receiver_rows), -1
    )
    of_ray = link[table.rx, table.tx]
    keep = np.flatnonzero((of_ray >= 0) & ~_left_out(table, scenario.simulation.paths_without))
    order = keep[np.argsort(of_ray[keep], kind="stable")]
    # one where an isotropic antenna is the reference range away, as rays from geometry are
    unit = 4.0 * np.pi * scenario.simulation.reference_range_m * table.frequency_hz / SPEED_OF_LIGHT_MPS
    amplitude = np.array([t.amplitude for t in scenario.transmitter])
    receiver, transmitter = np.divmod(of_ray[order], len(transmitter_rows))
    received = _received(table, scenario, order, receiver, normal_enu)
    n_link = len(receiver_rows) * len(transmitter_rows)
    return _Columns(
        first=np.searchsorted(of_ray[order], np.arange(n_link + 1)),
        length_m=table.length_m[order],
        gain=unit * amplitude[transmitter] * received,
    )


def _check_frequency(table: RayTable, scenario: Scenario) -> None:
    radio = scenario.radio
    if abs(table.frequency_hz - radio.centre_frequency_hz) > 0.5 * radio.sample_rate_hz:
        raise ScenarioError(
            f"{table.path}: traced at {table.frequency_hz:g} Hz, outside the recorded band about "
            f"`radio.centre_frequency_hz` = {radio.centre_frequency_hz:g} Hz; trace it at that frequency"
        )


def _left_out(table: RayTable, patterns: tuple[str, ...]) -> npt.NDArray[np.bool_]:
    """(ray,) whether any step of its code matches a pattern."""
    compiled = [re.compile(fnmatch.translate(pattern)) for pattern in patterns]
    codes, of_ray = np.unique(table.code, return_inverse=True)
    hit = [any(p.match(step) for p in compiled for step in str(code).split("+")) for code in codes]
    return np.array(hit, np.bool_)[of_ray]


def _received(
    table: RayTable, scenario: Scenario, rays: IntArray, receiver: IntArray, normal_enu: FloatArray
) -> ComplexArray:
    """(ray,) what the antenna makes of each ray's field; ``receiver`` numbers those of the scenario."""
    if scenario.simulation.path_antenna == "isotropic":
        return table.a_theta[rays]
    theta, phi = table.theta_r[rays], table.phi_r[rays]
    unit_theta = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    unit_phi = np.stack([-np.sin(phi), np.cos(phi), np.zeros(len(phi))], axis=1)
    axis = _mirror_y_enu(scenario, normal_enu)[receiver]
    along = np.einsum("kx,kx->k", unit_theta, axis) * table.a_theta[rays]
    # θ points down where an upright dipole points up
    return np.asarray(-(along + np.einsum("kx,kx->k", unit_phi, axis) * table.a_phi[rays]))


def _mirror_y_enu(scenario: Scenario, normal_enu: FloatArray) -> FloatArray:
    """(receiver, xyz) the mirror's y axis; of calibration receivers straight up."""
    axis = np.tile([0.0, 0.0, 1.0], (len(scenario.receivers), 1))
    rot = geometry.rot_enu_from_mirror(normal_enu)
    for i in range(len(scenario.heliostat)):
        axis[scenario.receiver_rows(i)] = rot[i, :, 1]
    return axis
