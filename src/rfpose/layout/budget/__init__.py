"""Where the error of a mirror's normal comes from, source by source, before anything is built."""

from rfpose.layout.budget.plan import Plan, make_plan
from rfpose.layout.budget.sources import SOURCES
from rfpose.layout.budget.table import BudgetLine, ErrorBudget, error_budget, noise_bound, target_slope

__all__ = ["SOURCES", "BudgetLine", "ErrorBudget", "Plan", "error_budget", "make_plan", "noise_bound", "target_slope"]
