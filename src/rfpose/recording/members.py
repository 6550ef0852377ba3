"""Which files a recording is made of."""

from __future__ import annotations

from pathlib import Path

from rfpose.recording.sidecar import SCENARIO_FILE

__all__ = ["members"]

_IN_A_DIRECTORY = (
    SCENARIO_FILE,
    "*.sigmf-meta",
    "*.sigmf-data",
    "*/drf_properties.h5",
    "*/*/rf@*.h5",
    "*/metadata/dmd_properties.h5",
    "*/metadata/*/metadata@*.h5",
)


def members(path: Path) -> list[Path]:
    """Return the files that are read as the recording ``path``, whichever of the known formats it has."""
    if path.is_dir():
        return [found for pattern in _IN_A_DIRECTORY for found in path.glob(pattern)]
    if path.suffix in (".sigmf-meta", ".sigmf-data"):
        return [path.with_suffix(".sigmf-meta"), path.with_suffix(".sigmf-data"), path.with_name(SCENARIO_FILE)]
    if path.suffix == ".hdr":
        return [path, path.with_suffix("")]
    return [path]
