"""A window without a screen, and small files to open in it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario, load_scenario
from rfpose.viewer.app import check_installed

# a reason that can be read, instead of some import error deep inside a test
check_installed()

from PySide6.QtCore import QSettings  # noqa: E402

from rfpose.viewer.preferences import Preferences  # noqa: E402
from rfpose.viewer.window import MainWindow  # noqa: E402

MakeWindow = Callable[[], MainWindow]


def small_site() -> Scenario:
    """Table 2's ten transmitters, two mirrors, three short frames with a gap and a blocked transmitter."""
    shipped = load_scenario(shipped_scenario("table2_100m.toml"))
    return shipped.changed(
        heliostat=shipped.heliostat[:2],
        radio={"frame_samples": 20_000},
        site={"latitude_deg": -33.9, "longitude_deg": 18.9},
        simulation={
            "frame_count": 3,
            "frame_interval_s": 1.0,
            "blocked": [{"transmitter": "T4", "receivers": ["H01"]}],
            "dropped": [{"receiver": "H02_r0", "frame": 1, "first_sample": 500, "sample_count": 2000}],
        },
    )


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A scenario, its simulated recording and the result, beside each other."""
    folder = tmp_path_factory.mktemp("viewer")
    paths = {"scenario": folder / "site.toml", "recording": folder / "rec.h5", "result": folder / "result.h5"}
    paths["scenario"].write_text(small_site().to_toml())
    simulate(paths["scenario"], seed=3).save(paths["recording"])
    process(paths["recording"], paths["result"])
    return paths


@pytest.fixture
def preferences(tmp_path: Path, qapp: object) -> Preferences:
    return Preferences(QSettings(str(tmp_path / "viewer.ini"), QSettings.Format.IniFormat))


@pytest.fixture
def window(preferences: Preferences, qtbot) -> Iterator[MainWindow]:
    shown = MainWindow(preferences)
    qtbot.addWidget(shown)
    shown.resize(1280, 800)
    shown.show()
    yield shown
    shown.close()


@pytest.fixture
def wait(qtbot) -> Callable[..., None]:
    """Wait until a window's work is done (and, with a condition, until that holds)."""

    def until(shown: MainWindow, condition: Callable[[], bool] = lambda: True) -> None:
        qtbot.waitUntil(lambda: not shown.workers.jobs and condition(), timeout=30_000)

    return until


def field_of(n: int) -> np.ndarray:
    """(heliostat, xyz) mirrors on a spiral."""
    k = np.arange(n) + 0.5
    radius, angle = 90.0 * np.sqrt(k / max(n, 1)), 2.399963 * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, 2.0)], axis=1)
