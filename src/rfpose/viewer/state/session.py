"""The open document, what is selected in it, and what there is to say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from rfpose.viewer.state.document import Document
from rfpose.viewer.state.layout_edit import LayoutEdit
from rfpose.viewer.state.observed import Signal
from rfpose.viewer.state.playback import Playback

__all__ = ["Message", "Selection", "Session"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What is looked at; indices along the scenario's axes, names where the recording decides.

    ``frame`` counts the document's frames. None: nothing.
    """

    receiver: str | None = None
    transmitter: int | None = None
    reference: int = 0
    tone: int = 0
    frame: int = 0
    heliostat: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """One line for the user; an error stays until it is dismissed."""

    text: str
    is_error: bool = False


class Session:
    """What all views share.

    Attributes
    ----------
    opened
        Another document, or none.
    selected
        The selection changed; called with the old one.
    said
        A message came or went.
    """

    def __init__(self) -> None:
        self.opened = Signal()
        self.selected = Signal()
        self.said = Signal()
        self.document: Document | None = None
        self.layout: LayoutEdit | None = None
        self.playback = Playback()
        self.selection = Selection()
        self.message: Message | None = None

    def show(self, document: Document | None) -> None:
        """Put a document in place of the one before, which is closed."""
        before, self.document = self.document, document
        if before is not None and before is not document:
            before.close()
        self.layout = None
        self.selection = Selection()
        if document is not None:
            if document.scenario is not None:
                self.layout = LayoutEdit(document.scenario)
            receivers = document.receiver_ids
            self.selection = Selection(receiver=receivers[0] if receivers else None)
        self.playback.load(0 if document is None or document.track is None else document.track.n_instant)
        self.message = None
        if document is not None and document.notes:
            self.message = Message(text="; ".join(document.notes))
        self.opened.emit()
        self.said.emit()

    def select(self, **changes: Any) -> None:
        """Look at something else; what does not exist in the document is refused silently."""
        wanted = replace(self.selection, **changes)
        document = self.document
        if document is None:
            return
        if wanted.receiver is not None and wanted.receiver not in document.receiver_ids:
            wanted = replace(wanted, receiver=self.selection.receiver)
        n_transmitter = n_tone = n_heliostat = 0
        if document.scenario is not None:
            n_transmitter, n_tone = len(document.scenario.transmitter), len(document.scenario.tone)
            n_heliostat = len(document.scenario.heliostat)
        if wanted.transmitter is not None and not 0 <= wanted.transmitter < n_transmitter:
            wanted = replace(wanted, transmitter=None)
        if wanted.heliostat is not None and not 0 <= wanted.heliostat < n_heliostat:
            wanted = replace(wanted, heliostat=None)
        wanted = replace(
            wanted,
            reference=min(max(wanted.reference, 0), max(n_transmitter - 1, 0)),
            tone=min(max(wanted.tone, 0), max(n_tone - 1, 0)),
            frame=min(max(wanted.frame, 0), max(document.n_frame - 1, 0)),
        )
        if wanted != self.selection:
            before, self.selection = self.selection, wanted
            self.selected.emit(before)

    def tell(self, text: str, *, is_error: bool = False) -> None:
        """Say something to the user, in one line."""
        self.message = Message(text=" ".join(text.split()), is_error=is_error)
        self.said.emit()

    def dismiss(self) -> None:
        """Take the message away."""
        self.message = None
        self.said.emit()
