"""rfpose measures where mirrors point, by radio."""

__version__ = "0.1.0"
