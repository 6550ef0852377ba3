"""Addresses of brokers and servers."""

from __future__ import annotations

from collections.abc import Collection
from urllib.parse import SplitResult, urlsplit

from rfpose.errors import InvalidInputError

__all__ = ["address_of"]


def address_of(url: str, schemes: Collection[str], wanted: str) -> SplitResult:
    """Return the parts of an address.

    Parameters
    ----------
    url
        The address.
    schemes
        How it may begin.
    wanted
        What it should look like.

    Raises
    ------
    InvalidInputError
        Another scheme, no host, or a port that is none.
    """
    try:
        parts = urlsplit(url)
        sound = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound:
        raise InvalidInputError(f"`url` must be {wanted}, got {url!r}")
    return parts
