"""A scenario's things, as the rays meet them."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.geometry import rot_enu_from_mirror
from rfpose.propagation.site import place_things, soil_of, stand_of
from rfpose.scenario import load_scenario

TABLE2 = Path(__file__).resolve().parents[3] / "data" / "table2_100m.toml"


@pytest.fixture
def scenario():
    s = load_scenario(TABLE2)
    plates = [
        {"id": f"N{k}", "pivot_enu_m": (24.0, 3.0 + 5.0 * k, 2.0), "width_m": 2.0, "height_m": 3.0, "arm_m": 0.5}
        for k in range(3)
    ]
    box = {"id": "tower", "base_enu_m": (0.0, 0.0, 0.0), "size_m": (6.0, 4.0, 46.0), "azimuth_deg": 90.0}
    return s.changed(heliostat=s.heliostat[:2], site={"structures": {"plate": plates, "box": (box,)}})


def test_things_without_posture_or_outline_are_left_out(scenario):
    rot = rot_enu_from_mirror([[0, 1, 1], [0, 1, 1], [1, 0, 1], [np.nan] * 3, [0, 0, 1]])
    bare = place_things(scenario, rot)
    assert bare.names == ("N0", "N2", "tower", "ground")
    np.testing.assert_array_equal(bare.own_plate, [-1, -1])
    outlined = place_things(scenario.changed(heliostat={"width_m": 2.0, "height_m": 1.0}), rot)
    assert outlined.names == ("H01", "H02", "N0", "N2", "tower", "ground")
    np.testing.assert_array_equal(outlined.own_plate, [0, 1])
    plates = outlined.surroundings.plates
    np.testing.assert_allclose(plates.centre_enu_m[2], np.array([24.0, 3.0, 2.0]) + 0.5 * np.array([1, 0, 1]) / 2**0.5)
    np.testing.assert_allclose(plates.size_m, [[2, 1], [2, 1], [2, 3], [2, 3]])
    box = outlined.surroundings.boxes
    np.testing.assert_allclose(box.rot_enu_from_box[0], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_found_pivots_move_the_plates(scenario):
    s = scenario.changed(heliostat={"width_m": 2.0, "height_m": 1.0})
    rot = np.broadcast_to(np.eye(3), (5, 3, 3))
    found = np.full((5, 3), np.nan)
    found[1] = s.pivot_enu_m[1] + [0.1, 0.0, 0.0]
    moved = place_things(s, rot, pivot_enu_m=found).surroundings.plates.centre_enu_m
    still = place_things(s, rot).surroundings.plates.centre_enu_m
    np.testing.assert_allclose(moved - still, [[0, 0, 0], [0.1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]], atol=1e-12)


def test_the_ground_is_known_with_its_constants_only(scenario):
    assert soil_of(scenario) is None
    table = {"model": "fresnel", "permittivity": 15.0, "conductivity_s_per_m": 0.01, "height_m": -0.5}
    soil = soil_of(scenario.changed(reflection=table))
    assert (soil.permittivity, soil.conductivity_s_per_m, soil.height_m) == (15.0, 0.01, -0.5)


def test_receivers_stand_beyond_the_arm_and_missing_ones_are_nan(scenario):
    four = [*scenario.heliostat[0].receiver_mirror_m, (0.0, 0.9, 0.0)]
    more = scenario.heliostat[0].model_copy(
        update={"receiver_mirror_m": tuple(four), "receiver_ids": ("a", "b", "c", "d"), "arm_m": 0.25}
    )
    s = scenario.changed(heliostat=(more, scenario.heliostat[1]))
    stand = stand_of(s, np.broadcast_to(np.eye(3), (2, 3, 3)), np.array([-1, -1]))
    np.testing.assert_allclose(stand.receiver_mirror_m[0], np.add(four, [0, 0, 0.25]))
    assert np.isnan(stand.receiver_mirror_m[1, 3]).all()
