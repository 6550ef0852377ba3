"""What the studies share: which field, in which postures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from rfpose.cli._support import gathered

if TYPE_CHECKING:
    from rfpose.pipeline.layout.site import Postures

__all__ = ["CRITERIA", "ESTIMATORS", "StudiedHeliostats", "field_options"]

F = TypeVar("F", bound=Callable[..., Any])

# names only, since the modules that define them load numpy
ESTIMATORS = ("scenario", "independent", "rigid", "shared-clock", "carrier", "delays", "pivot", "reflection", "site")
CRITERIA = ("pdop", "independent", "rigid", "shared-clock", "site")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudiedHeliostats:
    """Which heliostats a study is about, and in which postures, as its options say."""

    field: Path | None
    suns_deg: tuple[tuple[float, float], ...]
    day: datetime | None
    year: int | None
    stow: bool

    def postures(self) -> Postures:
        """Return the postures that the options name."""
        from rfpose.pipeline.layout.site import Postures

        day = self.day
        if day is not None and not 1900 <= day.year <= 9998:
            raise click.UsageError(f"--day must lie between the years 1900 and 9998, got {day:%Y-%m-%d}")
        for azimuth, elevation in self.suns_deg:
            if not (math.isfinite(azimuth) and 0.0 < elevation <= 90.0):
                raise click.UsageError(
                    f"--sun AZ EL needs an elevation above 0 and up to 90 degrees, got {elevation:g}"
                )
        return Postures(suns_deg=self.suns_deg, day=None if day is None else day.date(), year=self.year, stow=self.stow)


def field_options(function: F) -> F:
    """Add ``--field``, ``--sun``, ``--day``, ``--year`` and ``--stow``; the command gets them as ``studied``."""
    function = gathered("studied", StudiedHeliostats)(function)
    options = (
        click.option("--stow", is_flag=True, help="Also the stow posture, face up."),
        click.option(
            "--year",
            type=click.IntRange(min=1900, max=9998),
            help="Every hour of the 21st of each month, sun above 5°.",
        ),
        click.option("--day", type=click.DateTime(["%Y-%m-%d"]), help="Every half hour of this day, sun above 5°."),
        click.option(
            "--sun",
            "suns_deg",
            type=(float, float),
            multiple=True,
            metavar="AZ EL",
            help="Mirrors reflect this sun onto the aim point [deg]; repeat for several.",
        ),
        click.option(
            "--field",
            type=click.Path(path_type=Path),
            help="CSV of heliostats (east_m, north_m) instead of the scenario's.",
        ),
    )
    for option in options:
        function = option(function)
    return function
