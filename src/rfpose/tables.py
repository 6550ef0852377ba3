"""Tables for people and programs: one of rows, as CSV and as a pandas DataFrame."""

from __future__ import annotations

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose.errors import InvalidInputError, install_remedy
from rfpose.files import write_atomically

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Tabled", "data_frame", "labelled_library", "write_csv"]


class Tabled(ABC):
    """What is a table of rows: `save` writes it as CSV, `to_pandas` gives it as a DataFrame."""

    __slots__ = ()

    @abstractmethod
    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return header and rows."""

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the table as CSV, numbers to six digits.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite what exists.

        Raises
        ------
        RecordingError
            The file exists, or cannot be written.
        """
        write_csv(path, *self.table(), force=force)

    def to_pandas(self) -> pd.DataFrame:
        """Return the table; needs pandas."""
        return data_frame(*self.table())


def write_csv(path: str | Path, header: Sequence[str], rows: Sequence[Sequence[Any]], *, force: bool = True) -> None:
    """Write rows as CSV: floats to six digits, everything else as it is.

    Raises
    ------
    RecordingError
        The file exists and ``force`` is not set, or it cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row] for row in rows)
    write_atomically(path, text.getvalue().encode(), force=force)


def data_frame(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> pd.DataFrame:
    """Return rows as a DataFrame.

    Raises
    ------
    InvalidInputError
        pandas is not installed.
    """
    frame: pd.DataFrame = labelled_library("pandas").DataFrame(list(rows), columns=list(header))
    return frame


def labelled_library(name: str) -> Any:
    """Return pandas or xarray, which only labelled tables need.

    Raises
    ------
    InvalidInputError
        It is not installed; says how to.
    """
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidInputError(f"this needs {name}; install it, {install_remedy('labelled')}") from error
