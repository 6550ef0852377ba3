"""A scenario with its transmitters at other places."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.layout.maps import check_site
from rfpose.scenario import Scenario, Transmitter, check_scenario

__all__ = ["scenario_with"]


def scenario_with(scenario: Scenario, transmitter_enu_m: npt.ArrayLike, *, n_existing: int = 0) -> Scenario:
    """Return the scenario with its transmitters at other places; as TOML by ``to_toml``.

    The first ``n_existing`` keep their names. Carriers are the scenario's own while they last; more transmitters
    share the band evenly anew.

    Raises
    ------
    ScenarioError
        The band cannot hold so many carriers.
    """
    place = check_site(transmitter_enu_m)
    names = [*scenario.transmitter_ids[:n_existing]]
    names += [f"T{k + 1}" for k in range(len(place)) if f"T{k + 1}" not in names][: len(place) - n_existing]
    radio = scenario.radio
    if len(place) <= len(scenario.transmitter):
        carrier = scenario.carrier_hz[: len(place)]
    else:
        half = 0.5 * radio.sample_rate_hz
        margin = radio.clock_search_ppm * 1e-6 * (radio.centre_frequency_hz + half)
        usable = half - margin - float(scenario.tone_hz.max())
        carrier = np.linspace(-1.0, 1.0, len(place)) * usable * len(place) / (len(place) + 1.0)
    amplitude = [t.amplitude for t in scenario.transmitter]
    amplitude += [1.0] * len(place)
    new = tuple(
        Transmitter(id=name, position_enu_m=tuple(map(float, p)), carrier_hz=float(f), amplitude=a)
        for name, p, f, a in zip(names, place, carrier, amplitude, strict=False)
    )
    # not model_copy: it would neither check the new transmitters nor drop the arrays made of the old ones
    data = scenario.model_dump(exclude_none=True)
    data["transmitter"] = [t.model_dump() for t in new]
    kept = {t.id for t in new}
    blocked = data.get("simulation", {}).get("blocked", ())
    if blocked:
        data["simulation"]["blocked"] = [b for b in blocked if b["transmitter"] in kept]
    return check_scenario(data)
