"""Small files for every command that needs some, made up here and marked as such.

What is true of them is known: the mount `TRUE` errs by `ERRORS`, and `rfpose calibrate` finds that.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rfpose import __version__
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.mount import Actuator, Mount, command, posture
from rfpose.files import claim
from rfpose.pipeline.demo import shipped_scenario
from rfpose.scenario import Scenario, load_scenario
from rfpose.sun import Location, sun_position, unix_seconds

__all__ = ["ERRORS", "KINDS", "TRUE", "write_sample"]

KINDS = ("paint", "camera", "drone", "motors")

SITE = Location(latitude_rad=float(np.radians(37.1)), longitude_rad=float(np.radians(-2.36)), altitude_m=500.0)
HELIOSTAT = "A1"
BOARD_ENU_M, BOARD_NORMAL = np.array([0.0, 0.0, 12.0]), np.array([0.0, 1.0, 0.0])
PLANNED = Mount(pivot_enu_m=np.array([6.0, 36.0, 1.5]), actuators=(Actuator(counts_per_unit=5000.0),) * 2)
ERRORS = {
    "axis_1_zero_rad": 6e-3, "axis_2_zero_rad": -4e-3, "pedestal_tilt_north_rad": 2e-3, "pedestal_tilt_east_rad": 1e-3,
}  # fmt: skip
TRUE = PLANNED.replace(**ERRORS)
_MORNING = "2026-03-20T07:30:00Z"
_N_HOUR = 10
_MARK = "SYNTHETIC.txt"


def write_sample(kind: str, directory: str | Path, *, seed: int = 0, force: bool = False) -> tuple[str, ...]:
    """Write a directory of made-up measurements, of one heliostat `A1` (PAINT: of two).

    Parameters
    ----------
    kind
        One of `KINDS`: calibration records in PAINT's layout; pictures of a target; a drone's log; a result of radio
        with the log of the motors. All but the first have the planned mount beside them.
    directory
        Appears when all is in it.
    seed
        Same seed, same files.
    force
        Replace what exists.

    Returns
    -------
    tuple
        Names of the files, within the directory.

    Raises
    ------
    InvalidInputError
        Another kind.
    RecordingError
        The directory exists, or cannot be written.
    """
    if kind not in KINDS:
        raise InvalidInputError(f"`kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    makers: Mapping[str, Callable[[Path, int], None]] = {
        "paint": _paint, "camera": _camera, "drone": _drone, "motors": _motors,
    }  # fmt: skip
    _refuse_strangers(Path(directory))
    with claim(directory, force=force, directories=True) as job:
        part = job.part(Path(directory))
        part.mkdir()
        makers[kind](part, seed)
        text = f"Made up by `rfpose sample {kind}` of rfpose {__version__}, seed {seed}. Nothing here was measured.\n"
        (part / _MARK).write_text(text)
        names = tuple(sorted(str(p.relative_to(part)) for p in part.rglob("*") if p.is_file()))
        job.complete(Path(directory))
    return names


def _refuse_strangers(directory: Path) -> None:
    """Raise where a directory holds what was not made up here: that is never replaced."""
    if directory.is_dir() and any(directory.iterdir()) and not (directory / _MARK).is_file():
        raise RecordingError(f"{directory}: holds files of others, which are never replaced; choose another directory")


def _paint(folder: Path, seed: int) -> None:
    from rfpose.pipeline.samples.paint import write_paint

    write_paint(
        folder, {"AA31": (10.0, 120.0, 1.5), "AB42": (-30.0, 140.0, 1.7)}, n_record=40, every_days=3.0, seed=seed
    )


def _camera(folder: Path, seed: int) -> None:
    """Take pictures over a day: the heliostat is told to aim at the board's centre, and its counts are whole."""
    from rfpose.feedback.camera.render import Beam, CameraView, Target, render
    from rfpose.feedback.optics import reflect, target_offset_m

    _planned(folder)
    (folder / "pictures").mkdir()
    rng = np.random.default_rng(seed)
    rows = []
    for i, (unix_s, sun) in enumerate(_suns()):
        count = np.rint(command(TRUE, sun_enu=sun, target_enu_m=BOARD_ENU_M).count)
        got = posture(TRUE, count)
        beam = reflect(got.normal_enu, sun)
        off = target_offset_m(got.centre_enu_m, beam, target_enu_m=BOARD_ENU_M, target_normal_enu=BOARD_NORMAL)
        image = render(Target(), CameraView(), Beam(centre_m=(float(off[0]), float(off[1]))), rng=rng)
        _save_png(folder / "pictures" / f"{i}.png", image)
        rows.append([f"{i}.png", _iso(unix_s), HELIOSTAT, *count.tolist()])
    _table(folder / "pictures" / "pictures.csv", "file,time_utc,heliostat,axis_1,axis_2", rows)
    board = {"centre_enu_m": BOARD_ENU_M.tolist(), "normal_enu": BOARD_NORMAL.tolist()}
    (folder / "pictures" / "board.toml").write_text(tomli_w.dumps(board))


def _drone(folder: Path, seed: int) -> None:
    from rfpose.feedback.drone import RtkDrone, fly

    _planned(folder)
    rng = np.random.default_rng(seed)
    (made,) = fly([TRUE], target_enu_m=BOARD_ENU_M, n_point=60, rng=rng, drone=RtkDrone(), layout="dome")
    names = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
    rows = [[HELIOSTAT, *c, *r[:3], *r[4:7]] for c, r in zip(made.count.tolist(), made.row.tolist(), strict=True)]
    _table(folder / "flight.csv", f"heliostat,axis_1,axis_2,{names}", rows)


def _motors(folder: Path, seed: int) -> None:
    """Write a result of radio over a day, and what the motors' counts were when its frames began."""
    from rfpose.pipeline.process import process
    from rfpose.pipeline.simulate import simulate

    _planned(folder)
    site = _radio_site()
    site.save(folder / "site.toml")
    process(simulate(site, seed=seed), folder / "night.h5", estimator="correlator")
    rows = [
        [_iso(unix_s), HELIOSTAT, *np.round(command(TRUE, sun_enu=sun, target_enu_m=BOARD_ENU_M).count, 3).tolist()]
        for unix_s, sun in _suns()
    ]
    _table(folder / "motors.csv", "time_utc,heliostat,axis_1,axis_2", rows)


def _radio_site() -> Scenario:
    """Table 2's transmitters about the one heliostat, which sends the sun to the board all day."""
    site = load_scenario(shipped_scenario("table2_100m.toml"))
    return site.with_field(PLANNED.pivot_enu_m[None], ids=[HELIOSTAT]).changed(
        name="Synthetic",
        site={
            "latitude_deg": float(np.degrees(SITE.latitude_rad)),
            "longitude_deg": float(np.degrees(SITE.longitude_rad)),
            "height_m": SITE.altitude_m,
            "aim_enu_m": BOARD_ENU_M,
        },
        radio={"frame_samples": 8000},
        simulation={
            "start": _MORNING,
            "frame_count": _N_HOUR,
            "frame_interval_s": 3600.0,
            "sun_azimuth_deg": None,
            "sun_elevation_deg": None,
        },
    )


def _suns() -> list[tuple[float, FloatArray]]:
    unix_s = unix_seconds([_MORNING])[0] + 3600.0 * np.arange(_N_HOUR)
    return list(zip(unix_s.tolist(), sun_position(unix_s, SITE).direction_enu, strict=True))


def _planned(folder: Path) -> None:
    drives = [{"counts_per_unit": 5000.0}, {"counts_per_unit": 5000.0}]
    content = {
        "format": "rfpose-mount",
        "version": 1,
        "made_by": {"rfpose": __version__, "synthetic": True},
        "site": {"latitude_deg": 37.1, "longitude_deg": -2.36, "altitude_m": SITE.altitude_m},
        "heliostat": {HELIOSTAT: {"pivot_enu_m": PLANNED.pivot_enu_m.tolist(), "actuators": drives}},
    }
    (folder / "planned.toml").write_text(tomli_w.dumps(content))


def _save_png(path: Path, grey: Any) -> None:
    from matplotlib.image import imsave

    imsave(path, np.repeat(grey[..., None], 3, axis=-1))


def _table(path: Path, header: str, rows: Sequence[Sequence[Any]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header.split(","), *rows])
    path.write_text(text.getvalue())


def _iso(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).isoformat()
