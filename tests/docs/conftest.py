"""The files that commands of the docs name."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import pytest

import rfpose as rf
from rfpose.errors import RfposeError
from rfpose.pipeline.samples import write_sample
from rfpose.pipeline.samples.paint import write_paint

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that commands name."""
    folder = tmp_path_factory.mktemp("workshop")
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    site = base.changed(
        heliostat=[h.changed(pivot_sigma_m=0.003, receiver_delay_sigma_s=0.0) for h in base.heliostat[:2]],
        site={"latitude_deg": 37.1, "longitude_deg": -2.36},
        radio={"frame_samples": 8000},
        multipath={"foresee": [], "visibility": False},
        simulation={
            "frame_count": 6,
            "tone_snr_db": 65.0,
            "sun_azimuth_deg": [110.0, 250.0],
            "sun_elevation_deg": [30.0, 60.0],
        },
    )
    site.save(folder / "site.toml")
    recording = rf.simulate(site, seed=1)
    (folder / "nights").mkdir()
    for name in ("recording", "night", "day", "nights/1"):
        recording.save(folder / f"{name}.h5")
    truth = recording.truth
    rows = [f"{h},0,{','.join(map(str, n))}" for h, n in zip(truth.heliostat_ids, truth.normal_enu[0], strict=True)]
    (folder / "camera.csv").write_text("\n".join(["id,frame,normal_e,normal_n,normal_u", *rows]))
    told = [{"id": h, "normal_enu": n.tolist()} for h, n in zip(truth.heliostat_ids, truth.normal_enu[0], strict=True)]
    for k, one in enumerate(told):
        one["receivers_enu_m"] = truth.receiver_enu_m[0, 3 * k : 3 * k + 3].tolist()
    (folder / "truth.json").write_text(json.dumps({"heliostats": told}))
    with contextlib.suppress(RfposeError):  # without the extra `sigmf`
        recording.save(folder / "recording", format="sigmf")
    (folder / "data").mkdir()
    for path in (ROOT / "data").glob("*.toml"):
        shutil.copy(path, folder / "data" / path.name)
    field_name = "tracking_100m.toml"
    field = rf.load_scenario(ROOT / "data" / field_name)
    short = {"first_hour": 11.9, "last_hour": 12.0, "stored": 1, "settle_s": 20.0}
    field.changed(heliostat=field.heliostat[:1], tracking=short).save(
        folder / "data" / "tracking_100m.toml", force=True
    )
    return folder


@pytest.fixture(scope="session")
def calibrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plant with motors' log, pictures and a flight."""
    folder = tmp_path_factory.mktemp("calibrations")
    for kind in ("motors", "camera", "drone"):
        write_sample(kind, folder / kind)
        shutil.copytree(folder / kind, folder / "all", dirs_exist_ok=True)
    write_paint(folder / "all" / "paint", {"AA31": (10.0, 120.0, 1.5)}, n_record=12)
    return folder / "all"
