"""Numbers, texts and arrays from files that somebody else wrote: bounded before memory or time is spent on them.

A few bytes can ask for gigabytes: ``1e999999999`` as an exact fraction, brackets within brackets, a file that never
ends, an array whose header lies. What is read here has a size, a depth and an exponent that are known beforehand.
"""

from __future__ import annotations

import json
import math
import numbers
import re
import sys
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt

from rfpose.errors import InvalidInputError, RecordingError, RfposeError

__all__ = [
    "ARRAY_BYTES",
    "RATE_LIMITS",
    "TEXT_BYTES",
    "beside",
    "exact_number",
    "exact_rate",
    "load_json",
    "load_toml",
    "parse_json",
    "parse_toml",
    "read_arrays",
    "read_text",
]

TEXT_BYTES: Final = 2**24
"""A text file longer than this is refused unless its reader allows more; JSON takes up to some thirty times as much
memory as it has bytes."""

ARRAY_BYTES: Final = 2**29
"""Arrays of one file that take more memory than this are refused unless their reader allows more."""

_DEPTH: Final = 64
_SAID: Final = 200
"""Characters of what a library says; some quote the whole of what they could not read."""
_DIGITS: Final = 100
_EXPONENT: Final = 100
_LARGEST_DENOMINATOR: Final = 1_000_000
RATE_LIMITS: Final = (Fraction(1, 1000), Fraction(10**12))
"""Slower or faster than any receiver; within them a rate never rounds to zero."""
_NUMBER: Final = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?(\d+))?|[+-]?\d+/\d+", re.ASCII)
_REMEDY: Final = "correct it or copy it again"

# A string or a comment is passed over as one; what is left are brackets, and keys with many dots. A string that is
# never closed ends with the text (or line): each character is looked at once, whatever the text.
_JSON_TOKEN: Final = re.compile(r'"(?:[^"\\]|\\.)*+"?|[\[\]{}]', re.DOTALL)
_TOML_TOKEN: Final = re.compile(
    r'"""(?:[^\\]|\\.)*?(?:"""|\Z)|'
    + r"'''.*?(?:'''|\Z)|"
    + r'"(?:[^"\\\n]|\\.)*+"?|'
    + r"'[^'\n]*+'?|#[^\n]*+|[\[\]{}]",
    re.DOTALL,
)
_TOML_LONG_KEY: Final = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{_DEPTH}}}", re.ASCII)

# TOML 1.1 lets a time end with its minutes; Python's reader is of 1.0
_TOML_MINUTE: Final = re.compile(
    r"^([ \t]*[\w-]+[ \t]*=[ \t]*\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d)(?=[Zz+\-]|[ \t]*(?:#|\r?$))", re.MULTILINE | re.ASCII
)


def exact_number(name: str, value: Any) -> Fraction:
    """Return a number exactly, without letting its exponent take memory.

    Parameters
    ----------
    name
        What it is called where it stands, for the message.
    value
        An integer, float, fraction or numpy scalar; or text: a decimal number, or two integers with ``/`` between.

    Raises
    ------
    InvalidInputError
        Not a number, not finite, text of more than 100 characters, or a size beyond 1e±100 (zero is fine).
    """
    if isinstance(value, bool):  # which is an integer to Python
        raise InvalidInputError(f"`{name}` must be a number, got {value}")
    if isinstance(value, str):
        shown = repr(value[:_DIGITS])
        match = _NUMBER.fullmatch(value.strip()) if len(value) <= _DIGITS else None
        if match is None:
            raise InvalidInputError(f"`{name}` must be a number of at most {_DIGITS} characters, got {shown}")
        if match[1] is not None and (len(match[1]) > 4 or int(match[1]) > 2 * _EXPONENT):
            raise InvalidInputError(f"`{name}` must lie within 1e±{_EXPONENT}, got {shown}")
        if re.search(r"/0+$", value.strip()):
            raise InvalidInputError(f"`{name}` must not divide by zero, got {shown}")
        found = Fraction(value.strip())
    elif isinstance(value, numbers.Rational):
        found = Fraction(int(value.numerator), int(value.denominator))
    elif isinstance(value, numbers.Real):
        if not math.isfinite(value):
            raise InvalidInputError(f"`{name}` must be finite, got {float(value)}")
        found = Fraction(float(value))
    else:
        raise InvalidInputError(f"`{name}` must be a number, got {value!r:.80}")
    if found and not Fraction(1, 10**_EXPONENT) <= abs(found) <= 10**_EXPONENT:
        raise InvalidInputError(f"`{name}` must lie within 1e±{_EXPONENT}, got {_short(found)}")
    return found


def exact_rate(name: str, value: Any) -> Fraction:
    """Return a sample rate [1/s]; a decimal number becomes the nearest fraction with a denominator up to a million.

    Files that give rates as decimal numbers cannot say a third. A fraction stays as it is.

    Raises
    ------
    InvalidInputError
        As `exact_number`; or negative, zero, slower than 0.001/s or faster than 1e12/s.
    """
    rate = exact_number(name, value)
    least, most = RATE_LIMITS
    if not least <= rate <= most:
        raise InvalidInputError(
            f"`{name}` must be a rate from {float(least):g} to {float(most):g} a second, got {_short(rate)}"
        )
    return rate if isinstance(value, numbers.Rational) else rate.limit_denominator(_LARGEST_DENOMINATOR)


def _short(number: Fraction) -> str:
    """Write a number of any size in a few characters."""
    try:
        return f"{float(number):.6g}"
    except OverflowError:  # an integer may have any number of digits
        return f"{'-' if number < 0 else ''}1e+{int(abs(number).numerator.bit_length() * math.log10(2))} or so"


def beside(name: str | Path, folder: Path | None) -> Path:
    """Return the file that another one names: beside that, in ``folder``, else from where the program runs."""
    near = Path(name) if folder is None else folder / name
    return Path(name) if Path(name).exists() and not near.exists() else near


def read_text(
    path: str | Path,
    *,
    limit: int = TEXT_BYTES,
    error: type[RfposeError] = RecordingError,
    remedy: str = _REMEDY,
) -> str:
    """Read a text in UTF-8, with or without byte order mark, of a bounded size.

    Parameters
    ----------
    path
        The file.
    limit
        Largest size [byte]; no more is read whatever the file is.
    error
        What is raised.
    remedy
        What the message tells to do about a text that is not as it should be.

    Raises
    ------
    RfposeError
        ``error``: missing, unreadable, too long, or not UTF-8 (line and column are named).
    """
    try:
        with open(path, "rb") as file:
            content = file.read(limit + 1)
    except OSError as failure:
        raise error(
            f"{path}: cannot be read: {failure.strerror or failure}; check the path and its rights"
        ) from failure
    except ValueError as failure:  # a name with a zero byte
        raise error(f"{path!r}: cannot be read: {failure}; check the path") from failure
    if len(content) > limit:
        raise error(f"{path}: is longer than {limit:_} bytes, more than such a file may hold; check that it is the one")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        line = content.count(b"\n", 0, failure.start) + 1
        column = failure.start - content.rfind(b"\n", 0, failure.start)
        raise error(
            f"{path}: is not text in UTF-8 (byte {content[failure.start]:#04x} at line {line} column {column}); "
            "save it as UTF-8, or check that it is the right file"
        ) from failure


def load_json(
    path: str | Path,
    *,
    limit: int = TEXT_BYTES,
    error: type[RfposeError] = RecordingError,
    remedy: str = _REMEDY,
) -> Any:
    """Read a JSON file; see `read_text` and `parse_json`."""
    return parse_json(
        read_text(path, limit=limit, error=error, remedy=remedy), source=str(path), error=error, remedy=remedy
    )


def load_toml(
    path: str | Path,
    *,
    limit: int = TEXT_BYTES,
    error: type[RfposeError] = RecordingError,
    remedy: str = _REMEDY,
) -> dict[str, Any]:
    """Read a TOML file; see `read_text` and `parse_toml`."""
    return parse_toml(
        read_text(path, limit=limit, error=error, remedy=remedy), source=str(path), error=error, remedy=remedy
    )


def parse_json(text: str, *, source: str, error: type[RfposeError] = RecordingError, remedy: str = _REMEDY) -> Any:
    """Parse JSON of bounded depth, whose numbers are finite and whose integers fit 64 bits.

    Parameters
    ----------
    text
        What to parse.
    source
        File, and place inside it, for messages.
    error, remedy
        As for `read_text`.

    Raises
    ------
    RfposeError
        ``error``; the message names line and column, or the keys that lead to a number.
    """
    _refuse_depth(text, _JSON_TOKEN, source, error, remedy)
    found = _parsed("JSON", json.loads, text, source, error, remedy)
    _refuse_numbers(found, "", source, error, remedy, finite=True)
    return found


def parse_toml(
    text: str, *, source: str, error: type[RfposeError] = RecordingError, remedy: str = _REMEDY
) -> dict[str, Any]:
    """Parse TOML of bounded depth, whose integers fit 64 bits as its standard says; see `parse_json`."""
    bare = _refuse_depth(text, _TOML_TOKEN, source, error, remedy)
    if (chain := _TOML_LONG_KEY.search(bare)) is not None:
        line = bare.count("\n", 0, chain.start()) + 1
        raise error(f"{source}: a key of more than {_DEPTH} parts at line {line}; {remedy}")
    text = _TOML_MINUTE.sub(r"\1:00", text)
    found: dict[str, Any] = _parsed("TOML", tomllib.loads, text, source, error, remedy)
    _refuse_numbers(found, "", source, error, remedy, finite=False)
    return found


def _parsed(
    language: str, parse: Callable[[str], Any], text: str, source: str, error: type[RfposeError], remedy: str
) -> Any:
    try:
        return parse(text)
    except (ValueError, RecursionError) as failure:  # Python's own limit on digits is a ValueError as well
        raise error(f"{source}: not valid {language}: {failure!s:.{_SAID}}; {remedy}") from failure


def _refuse_depth(text: str, token: re.Pattern[str], source: str, error: type[RfposeError], remedy: str) -> str:
    """Raise where brackets lie deeper than any file needs; return the text with its strings and comments shortened."""
    depth = 0

    def shorten(match: re.Match[str]) -> str:
        nonlocal depth
        found = match[0]
        if found in "[{":
            depth += 1
            if depth > _DEPTH:
                line = text.count("\n", 0, match.start()) + 1
                column = match.start() - text.rfind("\n", 0, match.start())
                raise error(f"{source}: nested deeper than {_DEPTH} at line {line} column {column}; {remedy}")
            return found
        if found in "]}":
            depth -= 1
            return found
        return "_" + "\n" * found.count("\n")

    return token.sub(shorten, text)


def _refuse_numbers(
    value: Any, place: str, source: str, error: type[RfposeError], remedy: str, *, finite: bool
) -> None:
    """Raise at an integer beyond 64 bits, and at NaN or infinity where there may be none, naming where it stands."""
    if isinstance(value, dict):
        for key, item in value.items():
            _refuse_numbers(item, f"{place}.{key}" if place else key, source, error, remedy, finite=finite)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            _refuse_numbers(item, f"{place}[{i}]", source, error, remedy, finite=finite)
    elif isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise error(
            f"{source}: `{place}` is an integer that does not fit 64 bits ({_short(Fraction(value))}); {remedy}"
        )
    elif finite and isinstance(value, float) and not math.isfinite(value):
        raise error(f"{source}: `{place}` is {value}, which is no JSON number; {remedy}")


def read_arrays(
    path: str | Path,
    names: Iterable[str],
    *,
    limit: int = ARRAY_BYTES,
    error: type[RfposeError] = RecordingError,
    remedy: str = _REMEDY,
) -> dict[str, npt.NDArray[Any]]:
    """Read named arrays of numbers or text from numpy's ``.npz``; nothing in it is ever unpickled.

    Parameters
    ----------
    path
    names
        Arrays that must be there; others are not looked at.
    limit
        Bytes that they may take together.
    error, remedy
        As for `read_text`.

    Raises
    ------
    RfposeError
        ``error``: no such file, no archive, damaged, an array missing, of objects, or larger than its file can hold.
        The message names file and array.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            left, found = limit, {}
            for name in names:
                found[name] = _read_array(archive, f"{name}.npy", left)
                left -= found[name].nbytes
    except KeyError as failure:
        raise error(f"{path}: lacks the array `{name}`; {remedy}") from failure
    except OSError as failure:
        raise error(f"{path}: cannot be read: {failure.strerror or failure}; {remedy}") from failure
    # what a damaged archive raises differs by where the damage is
    except (ValueError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error) as failure:
        raise error(f"{path}: no sound archive of arrays (numpy's npz): {failure!s:.{_SAID}}; {remedy}") from failure
    return found


def _read_array(archive: zipfile.ZipFile, member: str, limit: int) -> npt.NDArray[Any]:
    """Return an array whose header agrees with the size of its member; ValueError says what does not."""
    size = archive.getinfo(member).file_size
    with archive.open(member) as file:
        shape, by_columns, kind = _array_header(file, member)
        if kind.kind not in "biufcU":
            raise ValueError(f"`{member}` holds {kind}, neither numbers nor text")
        count = math.prod(shape)
        if count * kind.itemsize > limit:
            raise ValueError(f"`{member}` of shape {shape} takes more than the {limit} bytes allowed")
        content = file.read(min(count * kind.itemsize + 1, size))
        if len(content) != count * kind.itemsize:
            raise ValueError(f"`{member}` of shape {shape} should have {count * kind.itemsize} bytes")
    array = np.frombuffer(content, kind).reshape(shape, order="F" if by_columns else "C")
    array = array.astype(kind.newbyteorder("="), order="C")
    if kind.kind == "U" and np.any(array.reshape(-1).view(np.uint32) > sys.maxunicode):
        raise ValueError(f"`{member}` holds what is no text")
    return array


def _array_header(file: IO[bytes], member: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"`{member}` is of format version {version}")
    shape, by_columns, kind = readers[version](file)
    if any(n < 0 for n in shape):
        raise ValueError(f"`{member}` has shape {shape}")
    return shape, by_columns, kind
