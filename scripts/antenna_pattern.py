"""Make the antenna pattern of a type of mirror by NEC-2, the method of moments: dipoles before or beside a plate.

Each receiver transmits in turn, the others are loaded; what it radiates is, by reciprocity, what it receives. The plate
is a grid of wires whose surface is that of the sheet. Needs PyNEC: ``pip install 'rfpose[nec]'``.

Run ``python scripts/antenna_pattern.py --help``; docs/antenna-patterns.md says what comes of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from rfpose.antenna import AntennaPattern
from rfpose.errors import RfposeError, install_remedy
from rfpose.pipeline.formats.antenna_file import write_pattern

SPEED_MPS = 299_792_458.0
WIRE_RADIUS_M = 0.002
PLATE_TAG = 1_000
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Model:
    """A mirror as NEC is told of it."""

    place: np.ndarray
    axis: np.ndarray
    plate_m: tuple[float, float]
    cells: int
    dipole_m: float
    load_ohm: float

    def context(self, frequency_hz: float):
        """Return NEC's context with geometry, loads and frequency."""
        import PyNEC  # an extra

        context = PyNEC.nec_context()
        geometry = context.get_geometry()
        for tag, middle in enumerate(self.place, 1):
            ends = middle - 0.5 * self.dipole_m * self.axis, middle + 0.5 * self.dipole_m * self.axis
            geometry.wire(tag, 3, *map(float, np.concatenate(ends)), WIRE_RADIUS_M, 1.0, 1.0)
        for begin, end, radius in self.plate_wires():
            geometry.wire(PLATE_TAG, 1, *map(float, (*begin, 0.0, *end, 0.0)), radius, 1.0, 1.0)
        context.geometry_complete(0)
        context.gn_card(-1, 0, 0, 0, 0, 0, 0, 0)
        for tag in range(1, len(self.place) + 1):
            context.ld_card(4, tag, 2, 2, self.load_ohm, 0.0, 0.0)
        context.fr_card(0, 1, frequency_hz / 1e6, 0.0)
        return context

    def plate_wires(self):
        """Yield the wires of the plate, cell by cell: both ends and the radius of equal surface."""
        if not self.cells:
            return
        width, height = self.plate_m
        n_y = max(2, round(self.cells * height / width))
        x, y = np.linspace(-width / 2, width / 2, self.cells + 1), np.linspace(-height / 2, height / 2, n_y + 1)
        radius = 0.5 * (width / self.cells + height / n_y) / (2.0 * math.pi)
        for i, u in enumerate(x):
            for j, v in enumerate(y):
                if i < self.cells:
                    yield (u, v), (x[i + 1], v), radius
                if j < n_y:
                    yield (u, v), (u, y[j + 1]), radius

    def responses(self, frequency_hz: float, n_polar: int, n_azimuth: int) -> np.ndarray:
        """Return responses (receiver, polar, azimuth, component), phases at each receiver's own place."""
        step = 180.0 / (n_polar - 1)
        wave_number = 2.0 * math.pi * frequency_hz / SPEED_MPS
        polar, azimuth = np.meshgrid(
            np.linspace(0.0, math.pi, n_polar), np.arange(n_azimuth) * (2.0 * math.pi / n_azimuth), indexing="ij"
        )
        towards = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
        context = self.context(frequency_hz)
        found = np.empty((len(self.place), n_polar, n_azimuth, 2), complex)
        for r, place in enumerate(self.place):
            context.ex_card(0, r + 1, 2, 0, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            context.rp_card(0, n_polar, n_azimuth, 0, 0, 0, 0, 0.0, 0.0, step, 360.0 / n_azimuth, 0.0, 0.0)
            field = context.get_radiation_pattern(r)
            both = np.stack([np.array(field.get_e_theta()), np.array(field.get_e_phi())], axis=-1)
            at_origin = both.reshape(n_azimuth, n_polar, 2).transpose(1, 0, 2)
            found[r] = at_origin * np.exp(-1j * wave_number * (towards @ place))[..., None]
        return found

    def alone(self, frequency_hz: float) -> complex:
        """Return what one such dipole radiates broadside in free space: the unit of responses."""
        upright = replace(self, place=np.zeros((1, 3)), axis=np.array([0.0, 0.0, 1.0]), cells=0)
        return -complex(upright.responses(frequency_hz, 3, 2)[0, 1, 0, 0])  # at the horizon θ̂ is −z


def pattern_of(model: Model, frequency_hz: np.ndarray, step_deg: float) -> AntennaPattern:
    """Return the pattern; its sigma is what a mesh of 0.7 times as many cells makes of it."""
    n_polar = round(180.0 / step_deg) + 1
    n_azimuth = 2 * (n_polar - 1)
    coarse = replace(model, cells=round(0.7 * model.cells))
    response, other = [], []
    for frequency in frequency_hz:
        unit = model.alone(frequency)
        response.append(model.responses(frequency, n_polar, n_azimuth) / unit)
        other.append(coarse.responses(frequency, n_polar, n_azimuth) / unit)
        click.echo(f"{frequency / 1e6:.6g} MHz done", err=True)
    fine, rough = np.array(response), np.array(other)
    # a factor common to all receivers means nothing, and is not told from the mesh's error
    factor = np.vdot(rough, fine) / np.vdot(rough, rough)
    difference = np.linalg.norm(fine - factor * rough, axis=-1) / 2.0  # two components, real and imaginary part
    return AntennaPattern(
        frequency_hz=frequency_hz,
        receiver_mirror_m=model.place,
        axis_mirror=np.tile(model.axis, (len(model.place), 1)),
        response=fine,
        sigma=difference,
    )


@click.command()
@click.option("--receiver", "receivers", nargs=3, type=float, multiple=True, required=True, metavar="X Y Z",
              help="Place of a receiver in the mirror frame [m]; once for each.")  # fmt: skip
@click.option("--mhz", type=float, multiple=True, required=True, help="Frequency [MHz]; may be given several times.")
@click.option("--plate", nargs=2, type=float, default=(2.0, 2.0), show_default=True, help="Width, height [m].")
@click.option("--axis", type=click.Choice(list(AXES)), default="y", show_default=True, help="Of the dipoles.")
@click.option("--cells", type=click.IntRange(4, 120), default=26, show_default=True, help="Of the mesh, in the width.")
@click.option("--step", type=float, help="Of the table, a divisor of 180 [deg]; default: what the plate's size needs.")
@click.option("--dipole", "dipole_m", type=float, default=0.1, show_default=True, help="Length of a dipole [m].")
@click.option("--load", "load_ohm", type=float, default=50.0, show_default=True, help="Of each receiver [ohm].")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The pattern's file.")
@click.option("--force", is_flag=True, help="Replace it.")
def main(receivers, mhz, plate, axis, cells, step, dipole_m, load_ohm, output, force):
    """Make a pattern's file by NEC-2."""
    try:
        import PyNEC  # noqa: F401
    except ImportError as error:
        raise click.ClickException(f"PyNEC is not installed; {install_remedy('nec')}") from error
    model = Model(
        place=np.array(receivers), axis=np.array(AXES[axis]), plate_m=plate, cells=cells, dipole_m=dipole_m,
        load_ohm=load_ohm,
    )  # fmt: skip
    frequency_hz = np.unique(np.array(mhz)) * 1e6
    cell_m, wavelength_m = max(plate) / cells, SPEED_MPS / frequency_hz[-1]
    if cell_m > wavelength_m / 6.0:
        click.echo(f"cells of {cell_m:.3g} m are more than a sixth of the wavelength, {wavelength_m:.3g} m", err=True)
    step = step or fitting_step_deg(model, frequency_hz[-1])
    if abs(180.0 / step - round(180.0 / step)) > 1e-9:
        raise click.UsageError(f"--step must divide 180 degrees, got {step}")
    try:
        write_pattern(output, pattern_of(model, frequency_hz, step), settings=_settings(model), force=force)
    except RfposeError as error:
        raise click.ClickException(str(error)) from error


def fitting_step_deg(model: Model, frequency_hz: float) -> float:
    """Return the widest step that carries the pattern: its waves come from as far as the plate's farthest corner."""
    corners = 0.5 * np.array(model.plate_m) * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    reach = max(np.linalg.norm(place[:2] - corner) for place in model.place for corner in corners)
    degree = 2.0 * math.pi * frequency_hz / SPEED_MPS * reach + 8.0
    return next(step for step in (10.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.5, 1.0, 0.5) if 180.0 / step > degree or step == 0.5)


def _settings(model: Model) -> dict[str, str]:
    return {
        "program": "scripts/antenna_pattern.py, NEC-2 by PyNEC",
        "plate_m": "{:g} x {:g}".format(*model.plate_m),
        "cells": str(model.cells),
        "dipole_m": f"{model.dipole_m:g}",
        "load_ohm": f"{model.load_ohm:g}",
    }


if __name__ == "__main__":
    main()
