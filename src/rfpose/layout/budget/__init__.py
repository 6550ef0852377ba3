"""Where the error of a mirror's normal comes from, source by source, before anything is built."""

from rfpose.layout.budget.plan import Plan, converter_share_of, make_plan
from rfpose.layout.budget.site import SiteMirrors, SitePlan, site_budget
from rfpose.layout.budget.sources import SOURCES
from rfpose.layout.budget.table import BudgetLine, ErrorBudget, error_budget, noise_bound, target_slope

__all__ = [
    "SOURCES",
    "BudgetLine",
    "ErrorBudget",
    "Plan",
    "SiteMirrors",
    "SitePlan",
    "converter_share_of",
    "error_budget",
    "make_plan",
    "noise_bound",
    "site_budget",
    "target_slope",
]
