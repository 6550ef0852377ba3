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
