"""A scene in which nothing reflects."""

from __future__ import annotations

import numpy as np

from rfpose.checks import FloatArray
from rfpose.multilat.reflection._kernels import SharedGeometry

__all__ = ["direct_rays"]


def direct_rays(transmitter_enu_m: FloatArray, n_group: int) -> SharedGeometry:
    """Return the direct ray alone, of transmitters (transmitter, xyz) [m]."""
    n_transmitter = len(transmitter_enu_m)
    return SharedGeometry(
        transmitter=np.array(transmitter_enu_m),
        image=np.zeros((0, n_transmitter, 3)),
        normal=np.zeros((0, 3)),
        carrier_k=np.zeros(n_transmitter),
        tone_k=np.zeros(n_group),
        kind=np.zeros(0, np.int64),
        permittivity=np.zeros((0, n_transmitter), np.complex128),
        spreads=True,
        coefficient=np.zeros(0, np.complex128),
        column=np.zeros(0, np.int64),
        common=np.zeros((1, n_transmitter, n_group, 1)),
    )
