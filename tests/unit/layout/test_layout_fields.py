"""Fields from CSV and from rules."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from rfpose.errors import GeometryError, ScenarioError
from rfpose.layout.fields import cornfield, radial_staggered
from rfpose.scenario import read_positions


def closest(place):
    return KDTree(place).query(place, k=2)[0][:, 1].min()


def test_csv_columns_in_any_order(tmp_path):
    file = tmp_path / "field.csv"
    file.write_text("\ufeffup_m, id,north_m,note,east_m\n2,a,20.5,x,10\n\n2.5,b,-20,y,1e1\n", encoding="utf-8")
    ids, pivot = read_positions(file)
    assert ids == ("a", "b")
    np.testing.assert_array_equal(pivot, [[10.0, 20.5, 2.0], [10.0, -20.0, 2.5]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("1.0,2.0\n3,4\n", "not a header"),
        ("id,east_rod,north_ft\na,1,2\n", "`east_rod` must be `east_m`, in metres"),
        ("id,east,north\na,1,2\n", "`east` says no unit"),
        ("id,x,y\na,1,2\n", "`east_m` is missing; the header has id, x, y"),
        ("east_m,north_m\n1,two\n", "line 2, `north_m`: 'two' is not a number"),
        ("east_m,north_m\n1,nan\n", "line 2, `north_m` must be finite"),
        ("east_m,north_m\n1,2\n1,2,3\n", "line 3 has 3 cells"),
        ("id,east_m,north_m\na,1,2\na,3,4\n", "`a` appears twice"),
        ("id,east_m,north_m\na,1,2\nb,1,2\n", "`a` and `b` stand at the same place"),
        ("east_m,north_m\n", "no heliostats"),
    ],
)
def test_bad_csv_names_the_place(tmp_path, text, message):
    file = tmp_path / "field.csv"
    file.write_text(text)
    with pytest.raises(ScenarioError, match=message) as caught:
        read_positions(file)
    assert str(file) in str(caught.value)


def test_missing_csv(tmp_path):
    with pytest.raises(ScenarioError, match=r"none\.csv: cannot be read"):
        read_positions(tmp_path / "none.csv")


@pytest.mark.parametrize("n", [1, 37, 2000])
def test_radial_staggered_keeps_its_distance(n):
    place = radial_staggered(n, first_radius_m=40.0, diagonal_m=12.0, height_m=2.0)
    assert place.shape == (n, 3)
    radius = np.hypot(place[:, 0], place[:, 1])
    assert radius.min() == pytest.approx(40.0)
    if n > 1:
        assert closest(place) >= 12.0 - 1e-9


def test_radial_rows_are_staggered():
    place = radial_staggered(40, first_radius_m=40.0, diagonal_m=12.0)
    radius = np.hypot(place[:, 0], place[:, 1])
    azimuth = np.arctan2(place[:, 0], place[:, 1])
    first = np.sort(azimuth[radius < 41.0])
    second = azimuth[(radius > 41.0) & (azimuth > 0.0) & (azimuth < 1.0)]
    gap = np.diff(first)[0]
    offset = (second[:, None] - first).ravel() / gap
    assert np.abs(offset - np.round(offset)).min() == pytest.approx(0.5)


def test_rows_too_close_are_refused():
    with pytest.raises(GeometryError, match="row_spacing_m"):
        radial_staggered(10, first_radius_m=40.0, diagonal_m=12.0, row_spacing_m=5.0)


def test_cornfield_is_the_nearest_of_a_lattice():
    place = cornfield(500, column_m=10.0, row_m=8.0, inner_radius_m=30.0)
    radius = np.hypot(place[:, 0], place[:, 1])
    assert len(np.unique(place.round(6), axis=0)) == 500
    assert radius.min() >= 30.0
    assert closest(place) == pytest.approx(np.hypot(5.0, 8.0))
    # area a heliostat is column × row
    assert np.pi * (radius.max() ** 2 - 30.0**2) / 80.0 == pytest.approx(500, rel=0.05)
