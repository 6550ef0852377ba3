"""Ways of steering mirrors: what each knows, and what it measures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from rfpose.errors import InvalidInputError
from rfpose.feedback.tracking import _kernels

__all__ = ["METHODS", "Method", "choose"]

Knowledge = Literal["nominal", "camera", "bias", "berenguel", "drone", "radio"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One way of steering.

    Attributes
    ----------
    name, text
        Short, and in words.
    knowledge
        What the model of the mount rests on.
    feedback
        What is measured while tracking, by the kernels' number.
    learns
        The measurements also correct the model, while tracking.
    radio
        Whether it needs transmitters.
    collectors
        What it can steer.
    """

    name: str
    text: str
    knowledge: Knowledge = "nominal"
    feedback: int = _kernels.NO_FEEDBACK
    learns: bool = False
    radio: bool = False
    collectors: tuple[str, ...] = ("heliostat", "dish")

    @property
    def closes_by_radio(self) -> bool:
        """Whether its loop is closed by radio."""
        return self.feedback == _kernels.RADIO


METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method(name="open-loop", text="uncorrected open loop"),
        Method(name="encoder", text="servo on axis encoders", feedback=_kernels.ENCODER),
        Method(name="bias", text="last offset seen by camera", knowledge="bias", collectors=("heliostat",)),
        Method(
            name="berenguel", text="camera correction, weekly", knowledge="berenguel", collectors=("heliostat",)
        ),
        Method(
            name="camera-model", text="Malan's model fitted to camera days", knowledge="camera",
            collectors=("heliostat",),
        ),
        Method(name="drone-model", text="model fitted to drone flights", knowledge="drone", collectors=("heliostat",)),
        Method(name="sun-sensor", text="servo on a sun sensor", feedback=_kernels.SUN_SENSOR, collectors=("dish",)),
        Method(name="radio", text="radio closed loop", feedback=_kernels.RADIO, radio=True),
        Method(name="radio-model", text="open loop, model fitted to radio", knowledge="radio", radio=True),
        Method(
            name="radio-both", text="radio closed loop on a model that radio corrects", knowledge="radio",
            feedback=_kernels.RADIO, learns=True, radio=True,
        ),
    )
}  # fmt: skip
"""All methods by name, in the order of tables."""


def choose(names: Iterable[str], *, collector: str) -> tuple[Method, ...]:
    """Return methods by name; none given: all that can steer the collector.

    Raises
    ------
    InvalidInputError
        An unknown name, a name twice, a method that cannot steer the collector.
    """
    names = tuple(names)
    if not names:
        return tuple(m for m in METHODS.values() if collector in m.collectors)
    for name in names:
        if name not in METHODS:
            raise InvalidInputError(f"no tracking method is called {name!r}; known are {', '.join(METHODS)}")
        if collector not in METHODS[name].collectors:
            raise InvalidInputError(f"method {name!r} cannot steer a {collector}; leave it out or change `collector`")
    if len(set(names)) != len(names):
        raise InvalidInputError(f"`methods` must name each method once, got {', '.join(names)}")
    return tuple(METHODS[name] for name in names)
