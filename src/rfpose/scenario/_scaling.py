"""One layout for every field size: which keys of a scenario are lengths."""

from __future__ import annotations

from typing import Any

_LENGTH_KEYS = frozenset(
    {
        "aim_enu_m",
        "arm_m",
        "base_enu_m",
        "detour_m",
        "field_radius_m",
        "ground_height_sigma_m",
        "height_m",
        "inner_radius_m",
        "multipath_excess_m",
        "pivot_enu_m",
        "pivot_sigma_m",
        "point_enu_m",
        "position_enu_m",
        "reach_m",
        "receiver_mirror_m",
        "receiver_mirror_sigma_m",
        "receiver_survey_sigma_m",
        "reference_range_m",
        "size_m",
        "survey_sigma_m",
        "target_enu_m",
        "transmitter_survey_sigma_m",
        "wavelength_m",
        "width_m",
    }
)


def scale_lengths(node: Any, factor: float) -> None:
    """Multiply every length below ``node`` in place; a tone given by frequency has its wavelength scaled."""
    if isinstance(node, dict):
        if "modulation_index" in node and "frequency_hz" in node:
            node["frequency_hz"] = node["frequency_hz"] / factor
        for key, value in node.items():
            if key == "site":  # height above sea level is no part of the layout
                if "aim_enu_m" in value:
                    value["aim_enu_m"] = _times(value["aim_enu_m"], factor)
                scale_lengths(value.get("structures"), factor)
            elif key in _LENGTH_KEYS:
                node[key] = _times(value, factor)
            else:
                scale_lengths(value, factor)
    elif isinstance(node, list | tuple):
        for item in node:
            scale_lengths(item, factor)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_times(item, factor) for item in value]
    return value * factor
