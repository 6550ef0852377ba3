"""Poses outdoors: carriers compared between a mirror's receivers, with the rays in the model that geometry foresees."""

from rfpose.multilat.site.correlation import PostureCorrelation, found_correlation
from rfpose.multilat.site.fit import (
    Common,
    FieldAt,
    SiteKnowledge,
    SiteObservations,
    SitePoses,
    SiteSettings,
    Voltages,
    fit_site,
    spread_starts,
)
from rfpose.multilat.site.forecast import ForeseenMirrors, WorldErrors
from rfpose.multilat.site.survey import (
    CASES,
    ReferencePoses,
    Survey,
    SurveyConstants,
    SurveyPrior,
    lever_to_turn,
    survey_site,
)

__all__ = [
    "CASES",
    "Common",
    "FieldAt",
    "ForeseenMirrors",
    "PostureCorrelation",
    "ReferencePoses",
    "SiteKnowledge",
    "SiteObservations",
    "SitePoses",
    "SiteSettings",
    "Survey",
    "SurveyConstants",
    "SurveyPrior",
    "Voltages",
    "WorldErrors",
    "fit_site",
    "found_correlation",
    "lever_to_turn",
    "spread_starts",
    "survey_site",
]
