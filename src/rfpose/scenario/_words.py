"""What pydantic complains of, in words for who wrote the scenario."""

from __future__ import annotations

from pydantic import ValidationError


def in_words(error: ValidationError, place: str = "") -> str:
    """Put pydantic's first complaint as ``place: what is wrong``; places lie within ``place``."""
    complaints = error.errors()
    # a misspelt key is also a missing one; the misspelling is the better message
    first = min(complaints, key=lambda c: c["type"] != "extra_forbidden")
    for part in first["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    if first["type"] == "extra_forbidden":
        text = f"unknown key `{place}`; remove it or correct its spelling"
    elif first["type"] == "missing":
        text = f"`{place}` is missing"
    elif first["type"] == "value_error":
        reason = first["msg"].removeprefix("Value error, ")
        text = f"`{place}`: {reason}" if place else reason
    else:
        text = f"`{place}` {first['msg'][:1].lower()}{first['msg'][1:]}, got {str(first['input'])[:80]}"
    more = len(complaints) - 1
    return text + (f" (and {more} more)" if more else "")
