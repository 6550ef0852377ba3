"""Tables for people and programs: one of rows, as CSV and as a pandas DataFrame."""

from __future__ import annotations

import csv
import io
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfpose.errors import InvalidInputError, install_remedy
from rfpose.files import write_atomically

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Tabled", "data_frame", "labelled_library", "write_csv", "write_parquet", "write_table"]


class Tabled(ABC):
    """What is a table of rows: `save` writes it as CSV, `to_pandas` gives it as a DataFrame."""

    __slots__ = ()

    @abstractmethod
    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return header and rows."""

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the table: CSV, numbers to six digits; or Parquet, numbers as they are, if ``path`` ends so.

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
        write_table(path, *self.table(), force=force)

    def to_pandas(self) -> pd.DataFrame:
        """Return the table; needs pandas."""
        return data_frame(*self.table())


def write_csv(path: str | Path, header: Sequence[str], rows: Sequence[Sequence[Any]], *, force: bool = True) -> None:
    """Write rows as CSV: floats to six digits, NaN as nothing, times in ISO 8601.

    Raises
    ------
    RecordingError
        The file exists and ``force`` is not set, or it cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(cell) for cell in row] for row in rows)
    write_atomically(path, text.getvalue().encode(), force=force)


def _cell(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat(timespec="microseconds").replace("+00:00", "Z")
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


def write_table(path: str | Path, header: Sequence[str], rows: Sequence[Sequence[Any]], *, force: bool = True) -> None:
    """Write rows as Parquet where the name ends in ``.parquet``, else as CSV; raises as these do."""
    write = write_parquet if Path(path).suffix == ".parquet" else write_csv
    write(path, header, rows, force=force)


def write_parquet(
    path: str | Path, header: Sequence[str], rows: Sequence[Sequence[Any]], *, force: bool = True
) -> None:
    """Write rows as Parquet: numbers with all their digits, times as times, what is not known as null.

    Raises
    ------
    InvalidInputError
        pyarrow is not installed.
    RecordingError
        The file exists and ``force`` is not set, or it cannot be written.
    """
    arrow, parquet = labelled_library("pyarrow"), labelled_library("pyarrow.parquet")
    columns = {name: arrow.array([row[k] for row in rows], from_pandas=True) for k, name in enumerate(header)}
    image = io.BytesIO()
    parquet.write_table(arrow.table(columns), image)
    write_atomically(path, image.getvalue(), force=force)


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
    """Return pandas, xarray or pyarrow, which only labelled tables need.

    Raises
    ------
    InvalidInputError
        It is not installed; says how to.
    """
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InvalidInputError(
            f"this needs {name.partition('.')[0]}; install it, {install_remedy('labelled')}"
        ) from error
