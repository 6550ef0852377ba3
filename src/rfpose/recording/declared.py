"""What a file of samples does not say of itself, and its user does."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, Literal

from rfpose.errors import InvalidInputError
from rfpose.foreign import exact_number, exact_rate
from rfpose.recording.flat import SampleType, sample_type
from rfpose.recording.stamps import parse_stamp
from rfpose.scenario import ID_PATTERN, MAX_ID_LENGTH

__all__ = ["DECLARED_FORMATS", "Declared", "declared_from", "seconds_of"]

DECLARED_FORMATS: Final = ("raw", "wav")
_RECEIVER_ID: Final = re.compile(ID_PATTERN)
_KEYS: Final = {"type", "sample_type", "sample_rate_hz", "centre_frequency_hz", "start"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """What a user says of a file: needed for raw samples, wins over what a WAV file says.

    Attributes
    ----------
    format
        ``"raw"``: nothing but interleaved samples; ``"wav"``.
    sample_type
        One of `rfpose.recording.flat.SAMPLE_TYPES`; None: as the file says.
    sample_rate
        [1/s]; None: as the file says.
    start_s
        When the first sample was taken [s since 1970 UTC], exactly; None: as the file says, else not known.
    centre_frequency_hz
        Radio frequency at baseband zero [Hz]; None: as the file says, else not known.
    receiver_ids
        Of its channels in their order; raw samples have as many channels as there are names. Empty: one receiver, named
        as the file is.

    Raises
    ------
    InvalidInputError
        A value that makes no sense, or raw samples without type or rate.
    """

    format: Literal["raw", "wav"] = "raw"
    sample_type: str | None = None
    sample_rate: Fraction | None = None
    start_s: Fraction | None = None
    centre_frequency_hz: float | None = None
    receiver_ids: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.format not in DECLARED_FORMATS:
            raise InvalidInputError(f"`format` must be one of {', '.join(DECLARED_FORMATS)}, got {self.format!r:.40}")
        for name in ("sample_type", "sample_rate"):
            if self.format == "raw" and getattr(self, name) is None:
                raise InvalidInputError(f"`{name}` must be given for raw samples, whose file does not say it")
        if self.sample_type is not None:
            sample_type(self.sample_type)
        if self.sample_rate is not None:
            exact_rate("sample_rate", self.sample_rate)
        for name in self.receiver_ids:
            if not _RECEIVER_ID.fullmatch(name) or len(name) > MAX_ID_LENGTH:
                raise InvalidInputError(f"`receiver_ids` may hold letters, digits, `_`, `-` and `.`, got {name!r:.60}")
        if len(set(self.receiver_ids)) != len(self.receiver_ids):
            raise InvalidInputError("`receiver_ids` names one twice")

    @property
    def type(self) -> SampleType | None:
        """How samples are stored; None: as the file says."""
        return None if self.sample_type is None else sample_type(self.sample_type)


def declared_from(part: Mapping[str, Any], place: str) -> tuple[Declared | None, dict[str, Any]]:
    """Take what declares a file out of a manifest's table; return the rest, too."""
    rest = {key: value for key, value in part.items() if key not in _KEYS - {"start"}}
    if not set(part) & (_KEYS - {"start"}):
        return None, rest
    kind = part.get("type", "wav")
    if kind not in DECLARED_FORMATS:
        raise InvalidInputError(f"{place}: `type` must be one of {', '.join(DECLARED_FORMATS)}, got {kind!r:.40}")
    name, rate, centre = part.get("sample_type"), part.get("sample_rate_hz"), part.get("centre_frequency_hz")
    if name is not None and not isinstance(name, str):
        raise InvalidInputError(f"{place}: `sample_type` must be text, got {name!r:.40}")
    receivers = rest.get("receivers")
    declared = Declared(
        format=kind,
        sample_type=name,
        sample_rate=None if rate is None else exact_rate("sample_rate_hz", rate),
        centre_frequency_hz=None if centre is None else float(exact_number("centre_frequency_hz", centre)),
        start_s=None if "start" not in part else seconds_of(part["start"], f"{place}: `start`"),
        receiver_ids=tuple(receivers) if isinstance(receivers, list) and all(map(_is_text, receivers)) else (),
    )
    rest.pop("start", None)
    if declared.receiver_ids:
        rest.pop("receivers")
    return declared, rest


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def seconds_of(value: Any, name: str) -> Fraction:
    """Return a time as seconds since 1970 UTC, exactly: a number, or text such as 2026-09-21T14:00:00.123Z.

    Raises
    ------
    InvalidInputError
        Neither, or before 1970.
    """
    if hasattr(value, "isoformat"):  # TOML has times of its own
        value = value.isoformat().replace("+00:00", "Z")
    if isinstance(value, str) and "T" in value:
        try:
            return parse_stamp(value, Fraction(1)).samples
        except InvalidInputError as error:
            raise InvalidInputError(f"{name}: {str(error).replace('`core:datetime` ', '')}") from error
    try:
        found = exact_number(name.strip("`"), value)
    except InvalidInputError as error:
        if not isinstance(value, str):
            raise
        wanted = "a time such as 2026-09-21T14:00:00.123Z, or seconds since 1970"
        raise InvalidInputError(f"{name} must be {wanted}, got {value!r:.60}") from error
    if found < 0:
        raise InvalidInputError(f"{name} must not lie before 1970, got {float(found):g}")
    return Fraction(repr(value)) if isinstance(value, float) else found
