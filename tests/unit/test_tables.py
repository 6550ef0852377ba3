"""Tables for people."""

import math

from rfpose.tables import write_csv


def test_a_cell_that_is_no_number_is_empty(tmp_path):
    write_csv(tmp_path / "t.csv", ["id", "x"], [["A", math.nan], ["B", 1.5]])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["id,x", "A,", "B,1.5"]
