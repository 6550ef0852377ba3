"""Whole numbers behind real estimates: integer least squares with decorrelation."""

from rfpose.multilat.ambiguity.least_squares import IntegerSolution, IntegerStatus, integer_least_squares

__all__ = ["IntegerSolution", "IntegerStatus", "integer_least_squares"]
