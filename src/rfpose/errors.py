"""The errors that rfpose raises on purpose.

The caller's mistake raises one of these; a bad measurement becomes NaN and a status instead.
"""


class RfposeError(Exception):
    """Base of every error that rfpose raises on purpose."""


class InvalidInputError(RfposeError, ValueError):
    """An argument has the wrong shape, unit or value."""


class ScenarioError(RfposeError, ValueError):
    """A scenario file is malformed, inconsistent, or cannot be solved as described."""


class RecordingError(RfposeError, OSError):
    """A recording or result file cannot be read, written or understood."""


class GeometryError(RfposeError, ValueError):
    """Positions that admit no solution: coincident, collinear or coplanar points."""


def install_remedy(extra: str) -> str:
    """Return how to install an extra, in words that hold in a checkout and for an installed rfpose alike."""
    return f"in a checkout of rfpose: `pip install '.[{extra}]'`; else: `pip install 'rfpose[{extra}]'`"
