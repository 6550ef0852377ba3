"""Contradictions within a scenario: each check raises ValueError in the user's words."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rfpose.scenario._scenario import Scenario


def _check_ids(s: Scenario) -> None:
    for kind, ids in (("transmitter", s.transmitter_ids), ("heliostat", s.heliostat_ids)):
        seen: set[str] = set()
        for identifier in ids:
            if identifier in seen:
                raise ValueError(f"{kind} `{identifier}` appears twice; identifiers must be unique")
            seen.add(identifier)
    _check_receiver_ids(s)


def _check_receiver_ids(s: Scenario) -> None:
    owner: dict[str, str] = {}
    for receiver in s.receivers:
        mine = (
            "calibration_receiver"
            if receiver.heliostat is None
            else f"heliostat `{s.heliostat_ids[receiver.heliostat]}`"
        )
        if receiver.id not in owner:
            owner[receiver.id] = mine
            continue
        other = owner[receiver.id]
        belongs = f"appears twice in {mine}" if mine == other else f"appears twice: it belongs to {other} and to {mine}"
        raise ValueError(f"receiver `{receiver.id}` {belongs}; identifiers must be unique")


def _check_things(s: Scenario) -> None:
    structures = s.site.structures
    things = (("heliostat", s.heliostat), ("box", structures.box), ("plate", structures.plate))
    owner: dict[str, str] = {}
    for kind, those in things:
        for thing in those:
            if thing.id in owner:
                both = f"two of kind {kind}" if owner[thing.id] == kind else f"a {owner[thing.id]} and a {kind}"
                raise ValueError(f"`{thing.id}` names {both}; things on a site need identifiers of their own")
            owner[thing.id] = kind
    standing = [
        *(("transmitter", t.id, t.position_enu_m) for t in s.transmitter),
        *(("calibration receiver", c.id, c.position_enu_m) for c in s.calibration_receiver),
        *(("pivot of heliostat", h.id, h.pivot_enu_m) for h in s.heliostat),
        *(("pivot of plate", p.id, p.pivot_enu_m) for p in structures.plate),
    ]
    for box in structures.box:
        for kind, name, place in standing:
            if box.holds(place):
                raise ValueError(
                    f"box `{box.id}` of [site.structures] covers {kind} `{name}`; move one of them, or correct the "
                    "box's `base_enu_m`, `size_m` or `azimuth_deg`"
                )


def _check_transmitters_apart(s: Scenario) -> None:
    place = {t.id: t for t in s.transmitter if t.mast is None}
    for t in s.transmitter:
        if t.mast is not None and (t.mast not in place or place[t.mast].position_enu_m != t.position_enu_m):
            raise ValueError(
                f"transmitter `{t.id}` is one more carrier of `{t.mast}`, which must be another transmitter, at the "
                "same `position_enu_m` and without a `mast` itself"
            )
    for (i, a), (j, b) in itertools.combinations(enumerate(s.transmitter_enu_m), 2):
        if s.mast[i] != s.mast[j] and np.linalg.norm(a - b) < 1e-6:
            ids = s.transmitter_ids
            raise ValueError(
                f"transmitters `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one, or give the "
                f'second `mast = "{ids[i]}"` if it is one more carrier of that antenna'
            )


def _check_lines_in_band(s: Scenario) -> None:
    half_band = s.radio.sample_rate_hz / 2.0
    margin = s.radio.clock_search_ppm * 1e-6 * (s.radio.centre_frequency_hz + half_band)
    for transmitter, lines in zip(s.transmitter, s.line_hz, strict=True):
        worst = float(np.max(np.abs(lines)))
        if worst + margin >= half_band:
            raise ValueError(
                f"transmitter `{transmitter.id}` has a line {worst:.9g} Hz from the centre, outside the recorded band "
                f"of ±{half_band:.9g} Hz (less {margin:.4g} Hz for clock offset); move `carrier_hz` or raise "
                "`sample_rate_hz`"
            )


def _check_lines_apart(s: Scenario) -> None:
    resolution = s.radio.sample_rate_hz / s.radio.frame_samples
    n_line = s.line_hz.shape[1]
    lines = s.line_hz.ravel()
    order = np.argsort(lines)
    gap = np.diff(lines[order])
    tight = np.flatnonzero(gap < 2.0 * resolution)
    if tight.size:
        a, b = (divmod(int(order[k]), n_line) for k in (tight[0], tight[0] + 1))
        raise ValueError(
            f"lines of transmitters `{s.transmitter_ids[a[0]]}` and `{s.transmitter_ids[b[0]]}` are "
            f"{gap[tight[0]]:.6g} Hz apart and collide: a frame of {s.radio.frame_samples} samples resolves "
            f"{resolution:.6g} Hz and needs twice that; move a carrier, change a tone, or lengthen the frame"
        )


def _check_modulation(s: Scenario) -> None:
    total = sum(t.modulation_index for t in s.tone)
    if total > 1.0 + 1e-9:
        raise ValueError(
            f"the modulation indices add up to {total:.4g}; above 1 the envelope folds over: reduce `modulation_index`"
        )


def _check_simulation_names(s: Scenario) -> None:
    receivers = set(s.receiver_ids)
    for blockage in s.simulation.blocked:
        if blockage.transmitter not in s.transmitter_ids:
            raise ValueError(f"simulation.blocked names transmitter `{blockage.transmitter}`, which does not exist")
        for identifier in blockage.receivers:
            if identifier not in receivers and identifier not in s.heliostat_ids:
                raise ValueError(f"simulation.blocked names receiver `{identifier}`, which does not exist")
    for dropout in s.simulation.dropped:
        if dropout.receiver not in receivers:
            raise ValueError(f"simulation.dropped names receiver `{dropout.receiver}`, which does not exist")


def _check_clock_can_be_found(s: Scenario) -> None:
    if s.simulation.clock_offset_ppm > s.radio.clock_search_ppm:
        raise ValueError(
            f"simulation.clock_offset_ppm {s.simulation.clock_offset_ppm:g} lies outside what is searched, "
            f"radio.clock_search_ppm {s.radio.clock_search_ppm:g}; raise the latter"
        )


CHECKS: tuple[Callable[[Scenario], None], ...] = (
    _check_ids,
    _check_things,
    _check_transmitters_apart,
    _check_modulation,
    _check_lines_in_band,
    _check_lines_apart,
    _check_simulation_names,
    _check_clock_can_be_found,
)
