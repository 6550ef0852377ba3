"""Fields that more than one test measures in."""

import numpy as np

# Swart et al., Table 2: ten transmitters of a field of radius one (verification.md R1)
TABLE_2 = np.array(
    [
        [1.0, 0.0, 0.2],
        [0.5, 0.866, 0.3],
        [-0.5, 0.866, 0.2],
        [-1.0, 0.0, 0.3],
        [-0.5, -0.866, 0.2],
        [0.5, -0.866, 0.3],
        [0.433, 0.25, 0.4],
        [-0.433, 0.25, 0.4],
        [0.0, -0.5, 0.4],
        [0.0, 0.0, 0.5],
    ]
)

# a tracked field, keys of [tracking]
PERFECT = {
    "mount_errors": {
        "tilt_sigma_mrad": 0.0, "zero_sigma_mrad": 0.0, "nonorthogonality_sigma_mrad": 0.0, "canting_sigma_mrad": 0.0,
        "location_sigma_mm": 0.0, "worm_sigma_mrad": 0.0, "sag_sigma_mrad": 0.0, "thermal_sigma_mrad": 0.0,
        "creep_sigma_mrad_per_month": 0.0,
    },
    "wind": {"deflection_mrad_per_mps2": (0.0, 0.0)},
    "structure": {"natural_hz": 0.0},
    "drive": {"backlash_mrad": (0.0, 0.0)},
    "radio": {"plate_sigma_mrad": 0.0, "ground": "none"},
}  # fmt: skip
"""Nothing wrong but motor steps."""
