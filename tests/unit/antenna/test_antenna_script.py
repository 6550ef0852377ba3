"""scripts/antenna_pattern.py, where PyNEC is installed: a dipole alone, and image theory before a plate."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.antenna.sphere import theta_phi_vectors
from rfpose.pipeline.formats.antenna_file import read_pattern

pytest.importorskip("PyNEC", reason="PyNEC is not installed (extra `nec`)")

SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "antenna_pattern.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("antenna_pattern", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_a_dipole_without_a_plate_is_a_dipole(script):
    axis = np.array([0.0, 1.0, 0.0])
    model = script.Model(
        place=np.array([[0.3, -0.4, 0.2]]), axis=axis, plate_m=(1.0, 1.0), cells=0, dipole_m=0.05, load_ohm=50.0
    )
    found = model.responses(433e6, 19, 36)[0] / model.alone(433e6)
    # a dipole of 0.07 wavelengths is not quite a point
    np.testing.assert_allclose(found, np.moveaxis(theta_phi_vectors(19, 36) @ axis, 0, -1), atol=5e-3)


def test_the_middle_of_a_large_plate_is_nearly_image_theory(script, tmp_path):
    path = tmp_path / "plate.h5"
    arguments = ["--receiver", 0, 0, 0.2, "--receiver", 0.4, 0.3, 0.15, "--mhz", 300, "--plate", 3, 3, "--cells", 18]
    run = CliRunner().invoke(script.main, [*map(str, arguments), "-o", str(path)])
    assert run.exit_code == 0, run.output
    found = read_pattern(path)
    assert found.made_by["cells"] == "18"
    vector, _, sigma = found.pattern.table(300e6).vector_and_slope([[0, 0, 1.0]], 0)
    height_rad = 2 * np.pi * 300e6 / 299_792_458.0 * 0.2
    expected = 1.0 - np.exp(-2j * height_rad)
    # edges 1.5 wavelengths away, and wires for a sheet
    assert vector[0, 1] / expected == pytest.approx(1.0, abs=0.25)
    behind = found.pattern.table(300e6).vector([[0, 0, -1.0]], 0)
    assert abs(behind[0, 1]) < 0.3 * abs(expected)
    assert sigma[0] < 0.1


def test_wrong_wishes_are_told(script, tmp_path):
    path = tmp_path / "plate.h5"
    run = CliRunner().invoke(
        script.main, ["--receiver", "0", "0", "0.2", "--mhz", "300", "--step", "7", "-o", str(path)]
    )
    assert run.exit_code == 2
    assert "divide 180" in run.output
