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


class UnlikeError(RecordingError):
    """What would be read as one recording differs in rate, sample type or tuning; as parts it may be read."""


class GeometryError(RfposeError, ValueError):
    """Positions that admit no solution: coincident, collinear or coplanar points."""


class ClusterError(RfposeError, RuntimeError):
    """Workers in other processes cannot be reached, or cannot do what is asked of them."""


class PublishError(RfposeError, RuntimeError):
    """Poses cannot be handed to a broker, or a server for them cannot be started."""


def install_remedy(extra: str) -> str:
    """Return how to install what an extra needs, by the names of its packages.

    That holds whether rfpose is on an index or not, came from a wheel or is a checkout: of rfpose itself nothing is
    fetched, and what another project of that name may be is never asked for.
    """
    import re
    from importlib import metadata

    try:
        wanted = metadata.requires("rfpose") or []
    except metadata.PackageNotFoundError:  # run from a folder, not installed
        return f"in the folder of rfpose: `pip install '.[{extra}]'`"
    found = [re.match(rf"([^;]+?)\s*;.*extra == ['\"]{re.escape(extra)}['\"]", line) for line in wanted]
    names = [f"'{match[1]}'" for match in found if match is not None]
    return f"`pip install {' '.join(names)}`" if names else f"in the folder of rfpose: `pip install '.[{extra}]'`"
