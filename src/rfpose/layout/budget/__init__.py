"""Where the error of a mirror's normal comes from, source by source, before anything is built."""

from rfpose.layout.budget.plan import WorkingPoint, converter_share_of, working_point
from rfpose.layout.budget.site import SiteMirrors, SitePlan, site_budget
from rfpose.layout.budget.sources import SOURCES
from rfpose.layout.budget.table import BudgetLine, ErrorBudget, error_budget, noise_bound, target_slope

__all__ = [
    "SOURCES",
    "BudgetLine",
    "ErrorBudget",
    "SiteMirrors",
    "SitePlan",
    "WorkingPoint",
    "converter_share_of",
    "error_budget",
    "noise_bound",
    "site_budget",
    "target_slope",
    "working_point",
]
