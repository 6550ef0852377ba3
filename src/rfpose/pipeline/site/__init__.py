"""Pose ``site``: mirrors among reflections, by the rays that the site's geometry lets one expect."""

from rfpose.pipeline.site.field import SiteField, antenna_of
from rfpose.pipeline.site.forecast import SiteForecast, forecast_normals, foreseen_mirrors
from rfpose.pipeline.site.poses import SiteOutcome, check_site_solvable, solve_site_poses
from rfpose.pipeline.site.strays import stray_ranges

__all__ = [
    "SiteField",
    "SiteForecast",
    "SiteOutcome",
    "antenna_of",
    "check_site_solvable",
    "forecast_normals",
    "foreseen_mirrors",
    "solve_site_poses",
    "stray_ranges",
]
