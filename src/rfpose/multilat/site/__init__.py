"""Poses outdoors: carriers compared between a mirror's receivers, with the rays in the model that geometry foresees."""

from rfpose.multilat.site.fit import (
    Common,
    SiteKnowledge,
    SiteObservations,
    SitePoses,
    SiteSettings,
    Voltages,
    fit_site,
    spread_starts,
)

__all__ = [
    "Common",
    "SiteKnowledge",
    "SiteObservations",
    "SitePoses",
    "SiteSettings",
    "Voltages",
    "fit_site",
    "spread_starts",
]
