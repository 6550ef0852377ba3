"""Ray tables for tests, by the image method: written from docs/ray-tables.md and from nothing in the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

SPEED = 299_792_458.0


def image_table(
    names: list[str], receiver: np.ndarray, transmitter: np.ndarray, rf_hz: float, coefficient: complex = -0.3 + 0.1j
) -> dict[str, Any]:
    """Return the columns of a table: direct rays, and those off a level ground of one coefficient."""
    rows = []
    for r, place in enumerate(receiver):
        for i, source in enumerate(transmitter):
            for code, image, factor in (("", [1, 1, 1], 1.0), ("R:ground", [1, 1, -1], coefficient)):
                way = source * image - place
                length = float(np.linalg.norm(way))
                field = factor * SPEED / rf_hz / (4.0 * np.pi * length)
                theta, phi = np.arccos(way[2] / length), np.arctan2(way[1], way[0])
                rows.append((r, i, field, 0.1j * field, length, 0.0, theta, phi, code))
    columns = list(zip(*rows, strict=True))
    kinds = (np.int16, np.int16, np.complex128, np.complex128, np.float64, np.float32, np.float64, np.float64, np.str_)
    keys = ("rx", "tx", "a_theta", "a_phi", "length_m", "theta_t", "theta_r", "phi_r", "code")
    table = {key: np.array(column, kind) for key, column, kind in zip(keys, columns, kinds, strict=True)}
    return table | {
        "rx_names": np.array(names),
        "rx_enu_m": receiver,
        "tx_enu_m": transmitter,
        "frequency_hz": np.float64(rf_hz),
    }


def save(path: Path, table: dict[str, Any]) -> Path:
    """Write a table."""
    np.savez_compressed(path, **table)
    return path
