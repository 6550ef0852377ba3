"""Compile every kernel once, by doing each of rfpose's jobs on a field so small that only compiling takes time."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rfpose.engine import n_core
from rfpose.jit import compilations
from rfpose.pipeline.demo import shipped_scenario
from rfpose.scenario import Scenario, load_scenario

__all__ = ["JOBS", "WarmUp", "warm_up"]


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUp:
    """What compiling took.

    Attributes
    ----------
    compiled
        Kernels that were compiled; those that were before came from the cache.
    seconds
        Of all jobs [s].
    """

    compiled: int
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return both, with stable keys."""
        return {"compiled": self.compiled, "seconds": self.seconds}


def warm_up(*, on_progress: Callable[[int, int], None] | None = None) -> WarmUp:
    """Do each of `JOBS`, so that no later one has to compile.

    Processes do them side by side, one a core. Two that keep the same kernel for other types at the same time may lose
    one of them, so all are done once more here if anything was compiled, by then in seconds.

    Parameters
    ----------
    on_progress
        Called with jobs done and in all.

    Returns
    -------
    WarmUp
    """
    begun, before = time.monotonic(), compilations()
    n_job, n_process = len(JOBS), min(n_core(), len(JOBS))
    beside = range(n_job) if n_process > 1 else range(0)
    compiled, is_warm = 0, n_process > 1

    def tell(done: int) -> None:
        if on_progress is not None:
            on_progress(done, len(beside) + n_job)

    tell(0)
    running: list[subprocess.Popen[str]] = []
    pool = ThreadPoolExecutor(n_process)
    try:
        for done, count in enumerate(pool.map(partial(_compiled_beside, running), beside), 1):
            compiled += count or 0
            is_warm = is_warm and count == 0
            tell(done)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in running:
            process.kill()
    for i_job in range(n_job):
        if not is_warm:
            _do(i_job)
        tell(len(beside) + i_job + 1)
    return WarmUp(compiled=compiled + compilations() - before, seconds=time.monotonic() - begun)


def _compiled_beside(running: list[subprocess.Popen[str]], i_job: int) -> int | None:
    """Do a job in a process of its own and return how many kernels it compiled; None: it failed, as it will here."""
    text = (
        f"from {__name__} import _do; from {compilations.__module__} import compilations; _do({i_job}); "
        "print(compilations())"
    )
    command = [sys.executable, "-c", text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        running.append(process)
        told = process.communicate()[0]
    return int(told) if process.returncode == 0 else None


def _do(i_job: int) -> None:
    with tempfile.TemporaryDirectory(prefix="rfpose-warm-up-") as folder:
        JOBS[i_job](_small_site(), Path(folder))


def _small_site() -> Scenario:
    site = load_scenario(shipped_scenario("table2_100m.toml"))
    return site.changed(
        heliostat=site.heliostat[:2],
        radio={"frame_samples": 8000},
        simulation={"frame_count": 2, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0},
    )


def _simulate_and_measure(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.evaluate import evaluate
    from rfpose.pipeline.process import process
    from rfpose.pipeline.simulate import simulate

    simulate(site, seed=1).save(folder / "recording.h5")
    for k, estimator in enumerate(("hilbert", "correlator")):
        for pose in ("rigid", "independent"):
            result = process(folder / "recording.h5", folder / f"{k}_{pose}.h5", estimator=estimator, pose=pose)
    evaluate(result)
    evaluate(folder / "0_rigid.h5")  # arrays that came from a file are read-only, which is another type to numba


def _reflection_and_filter(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.process import process
    from rfpose.pipeline.simulate import simulate

    ground = site.changed(simulation={"ground": {"coefficient": (-0.3, 0.1)}})
    process(simulate(ground, seed=1), estimator="correlator", reflection="estimate", filtered=True)


def _pose_site(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.process import process
    from rfpose.pipeline.simulate import simulate

    plates = site.changed(heliostat={"width_m": 2.0, "height_m": 2.0, "pivot_sigma_m": 0.01})
    process(simulate(plates, seed=1), estimator="correlator", pose="site")


def _layouts(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.layout import budget, layout_map, optimise

    layout_map(site, sensitivity=True)
    budget(site, n_draw=2)
    optimise(site, starts=1)


def _tracking(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.track import track

    plan = load_scenario(shipped_scenario("tracking_100m.toml"))
    plan = plan.changed(heliostat=plan.heliostat[:2], tracking={"first_hour": 11.9, "last_hour": 12.0})
    track(plan, folder / "day.h5")


def _calibration(site: Scenario, folder: Path) -> None:
    from rfpose.pipeline.calibrate import calibrate
    from rfpose.pipeline.samples import write_sample

    write_sample("drone", folder / "flight")
    calibrate(mounts=folder / "flight" / "planned.toml", drone=folder / "flight" / "flight.csv")


JOBS: tuple[Callable[[Scenario, Path], None], ...] = (
    _simulate_and_measure,
    _tracking,
    _layouts,
    _reflection_and_filter,
    _pose_site,
    _calibration,
)
"""What is done, those first that have little in common; each is given a small site and a folder for its files."""
