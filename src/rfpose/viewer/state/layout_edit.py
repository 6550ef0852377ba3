"""Transmitters being moved about: edits, locks, undo and redo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.scenario import Scenario, Transmitter
from rfpose.viewer.models.live_layout import first_choice, free_carrier_hz, scenario_of_layout
from rfpose.viewer.state.observed import Signal

__all__ = ["LayoutEdit"]

_UNDO_DEPTH = 500


@dataclass(frozen=True, slots=True)
class _Snapshot:
    transmitters: tuple[Transmitter, ...]
    locked: frozenset[str]


class LayoutEdit:
    """A scenario's transmitters while its user moves them; the scenario itself stays as it is.

    Attributes
    ----------
    moved
        Transmitters or locks changed.
    chosen
        Estimator, tones, posture, costs or the field changed.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.moved = Signal()
        self.chosen = Signal()
        self.scenario = scenario
        self.choice = first_choice(scenario)
        self.pivot_enu_m: FloatArray | None = None
        self._now = _Snapshot(scenario.transmitter, frozenset())
        self._undo: list[_Snapshot] = []
        self._redo: list[_Snapshot] = []
        self._before_drag: _Snapshot | None = None

    # -- what is there -----------------------------------------------------------------------------------

    @property
    def transmitters(self) -> tuple[Transmitter, ...]:
        """As they stand now."""
        return self._now.transmitters

    @property
    def ids(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(t.id for t in self._now.transmitters)

    @property
    def locked(self) -> frozenset[str]:
        """Names of those that may not move."""
        return self._now.locked

    @property
    def can_undo(self) -> bool:
        """Whether there is something to take back."""
        return bool(self._undo)

    @property
    def can_redo(self) -> bool:
        """Whether something was taken back."""
        return bool(self._redo)

    def find(self, name: str) -> Transmitter:
        """Return a transmitter by name."""
        for transmitter in self._now.transmitters:
            if transmitter.id == name:
                return transmitter
        raise InvalidInputError(f"there is no transmitter `{name}`; choose one of {', '.join(self.ids)}")

    # -- edits -------------------------------------------------------------------------------------------

    def begin_drag(self) -> None:
        """Count all moves until `end_drag` as one."""
        if self._before_drag is None:
            self._before_drag = self._now

    def end_drag(self) -> None:
        """Make the drag one step of undo."""
        before, self._before_drag = self._before_drag, None
        if before is not None and before != self._now:
            self._remember(before)
            self.moved.emit()

    def move(
        self, name: str, *, east: float | None = None, north: float | None = None, up: float | None = None
    ) -> None:
        """Move a transmitter [m]; one that is locked stays. Coordinates that are not given stay, too."""
        old = self.find(name)
        if name in self.locked:
            return
        x, y, z = old.position_enu_m
        place = (x if east is None else east, y if north is None else north, z if up is None else up)
        if not all(np.isfinite(place)) or place == old.position_enu_m:
            return
        place = tuple(float(v) for v in place)  # type: ignore[assignment]
        self._set(
            tuple(t.model_copy(update={"position_enu_m": place}) if t.id == name else t for t in self.transmitters)
        )

    def add(self, east: float, north: float, up: float) -> str:
        """Add a transmitter [m] on a free carrier and return its name.

        Raises
        ------
        ScenarioError
            The band has no room for its carrier.
        """
        carrier = free_carrier_hz(self.scenario, self.transmitters)
        number = 1
        while f"T{number}" in self.ids:
            number += 1
        new = Transmitter(id=f"T{number}", position_enu_m=(east, north, up), carrier_hz=carrier)
        self._set((*self.transmitters, new))
        return new.id

    def remove(self, name: str) -> None:
        """Take a transmitter away.

        Raises
        ------
        InvalidInputError
            It is locked, or there is none of that name.
        """
        self.find(name)
        if name in self.locked:
            raise InvalidInputError(f"transmitter `{name}` is locked; unlock it first")
        self._set(tuple(t for t in self.transmitters if t.id != name))

    def lock(self, name: str, locked: bool) -> None:
        """Hold a transmitter where it is, or let it move again."""
        self.find(name)
        self._set(self.transmitters, self.locked | {name} if locked else self.locked - {name})

    def replace(self, transmitters: tuple[Transmitter, ...]) -> None:
        """Put all transmitters elsewhere in one step."""
        self._set(transmitters, self.locked & {t.id for t in transmitters})

    def undo(self) -> None:
        """Take the last step back."""
        if self._undo:
            self._redo.append(self._now)
            self._now = self._undo.pop()
            self.moved.emit()

    def redo(self) -> None:
        """Do again what was taken back."""
        if self._redo:
            self._undo.append(self._now)
            self._now = self._redo.pop()
            self.moved.emit()

    def choose(self, **changes: Any) -> None:
        """Change estimator, tones, posture, sun or costs; see `rfpose.viewer.models.live_layout.LayoutChoice`."""
        choice = replace(self.choice, **changes)
        if choice != self.choice:
            self.choice = choice
            self.chosen.emit()

    def use_field(self, pivot_enu_m: FloatArray | None) -> None:
        """Study another field (heliostat, xyz) [m]; None: the scenario's own."""
        self.pivot_enu_m = pivot_enu_m
        self.chosen.emit()

    def to_scenario(self) -> Scenario:
        """Return the layout as a scenario, checked.

        Raises
        ------
        ScenarioError
            It contradicts itself; the message points to the key.
        """
        return scenario_of_layout(self.scenario, self.transmitters, pivot_enu_m=self.pivot_enu_m)

    # -- helpers -----------------------------------------------------------------------------------------

    def _set(self, transmitters: tuple[Transmitter, ...], locked: frozenset[str] | None = None) -> None:
        new = _Snapshot(transmitters, self.locked if locked is None else frozenset(locked))
        if new == self._now:
            return
        if self._before_drag is None:
            self._remember(self._now)
        self._now = new
        self.moved.emit()

    def _remember(self, snapshot: _Snapshot) -> None:
        self._undo.append(snapshot)
        del self._undo[:-_UNDO_DEPTH]
        self._redo.clear()
