"""Pictures of a target with a heliostat's beam on it, as a camera on the ground takes them.

For tests and demonstrations: geometry by a pinhole, light by a sun disc with limb darkening, blurred by the mirror's
slope error and spread by its size. Nothing here is used by the chains that read pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError

__all__ = ["Beam", "CameraView", "PictureFlaws", "Target", "project_px", "render"]

Image = npt.NDArray[np.uint8]

_GRID = 161


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A flat target on a tower.

    Attributes
    ----------
    width_m, height_m
        Size [m].
    marker_m
        Side of the square black markers, one in each corner [m]; zero: none.
    inset_m
        From the target's edges to the markers' centres [m].
    white, tower, marker
        Brightness without beam: target, tower around it, markers; 255 is full scale.
    """

    width_m: float = 2.0
    height_m: float = 2.0
    marker_m: float = 0.12
    inset_m: float = 0.15
    white: float = 120.0
    tower: float = 70.0
    marker: float = 8.0

    def marker_centres_m(self) -> FloatArray:
        """Return right and up of the markers: upper left, upper right, lower right, lower left (4, 2) [m]."""
        x, y = 0.5 * self.width_m - self.inset_m, 0.5 * self.height_m - self.inset_m
        return np.array([[-x, y], [x, y], [x, -y], [-x, -y]])


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraView:
    """A camera that looks at a point near the target's centre.

    Attributes
    ----------
    right_m, up_m, front_m
        Camera's place: right, up and in front of the target, seen from in front [m].
    focal_px
        Focal length [pixel].
    shape_px
        Rows, columns.
    aim_m
        Point of the target's plane in the picture's middle (right, up) [m].
    roll_rad
        Turn of the camera about its line of sight [rad].

    Raises
    ------
    InvalidInputError
        A camera behind the target or without pixels.
    """

    right_m: float = 4.0
    up_m: float = -11.0
    front_m: float = 30.0
    focal_px: float = 3600.0
    shape_px: tuple[int, int] = (300, 375)
    aim_m: tuple[float, float] = (0.0, 0.0)
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        as_positive("front_m", self.front_m)
        as_positive("focal_px", self.focal_px)
        if min(self.shape_px) < 2:
            raise InvalidInputError(f"`shape_px` must be two or more each way, got {self.shape_px}")

    def axes(self) -> FloatArray:
        """Return the camera's right, down and forward in the target's right, up, front (3, 3), rows."""
        forward = np.array([self.aim_m[0], self.aim_m[1], 0.0]) - self.place_m()
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(self.roll_rad), np.sin(self.roll_rad)
        return np.stack([c * right + s * down, c * down - s * right, forward])

    def place_m(self) -> FloatArray:
        """Return the camera's place (right, up, front) [m]."""
        return np.array([self.right_m, self.up_m, self.front_m])


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """A heliostat's image on the target.

    Attributes
    ----------
    centre_m
        Right and up of its centre [m].
    distance_m
        Mirror to target [m].
    mirror_m
        Side of the square mirror, flat [m].
    slope_error_rad
        Of its surface, one component, of the normal [rad].
    sun_rad
        Angle subtended by the sun [rad].
    stretch, turn_rad
        Long over short axis where the beam falls aslant, and the long axis' direction from right [rad].
    level
        Brightness added at the brightest; 255 is full scale.
    """

    centre_m: tuple[float, float] = (0.0, 0.0)
    distance_m: float = 37.0
    mirror_m: float = 0.3
    slope_error_rad: float = 1.5e-3
    sun_rad: float = 9.3e-3
    stretch: float = 1.0
    turn_rad: float = 0.0
    level: float = 110.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFlaws:
    """What makes a picture worse.

    Attributes
    ----------
    noise
        Standard deviation of each pixel, in levels.
    side_light
        Brightness added to the tower on the target's right, where the low sun grazes it.
    flare
        Brightness of the lens flare: a veil over the whole picture and a chain of ghosts from its corner.
    """

    noise: float = 2.0
    side_light: float = 0.0
    flare: float = 0.0


def project_px(view: CameraView, point_m: npt.ArrayLike) -> FloatArray:
    """Return column and row of points of the target's plane.

    Parameters
    ----------
    view
        The camera.
    point_m : (..., 2)
        Right and up [m].
    """
    points = np.asarray(point_m, np.float64)
    line = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1) - view.place_m()
    seen = line @ view.axes().T
    rows, columns = view.shape_px
    middle = 0.5 * np.array([columns - 1, rows - 1])
    return np.asarray(view.focal_px * seen[..., :2] / seen[..., 2:] + middle)


def render(
    target: Target,
    view: CameraView,
    beams: Beam | tuple[Beam, ...] = (),
    *,
    disturbance: PictureFlaws | None = None,
    rng: np.random.Generator | None = None,
) -> Image:
    """Return a picture, eight bits a pixel.

    Parameters
    ----------
    target, view
        What is looked at, and from where.
    beams
        One heliostat's image, several, or none.
    disturbance
        Noise, side light and flare; left out: noise of two levels.
    rng
        Source of the noise; left out: none is added.

    Returns
    -------
    (row, column)
        Values beyond full scale are clipped, as a sensor does.
    """
    worse = disturbance or PictureFlaws()
    x, y = _plane(view)
    light = _surface(target, x, y, worse.side_light)
    for beam in (beams,) if isinstance(beams, Beam) else beams:
        light += beam.level * _flux(beam, x, y) * _reflectance(target, x, y)
    light += worse.flare * _flare(view.shape_px)
    if rng is not None:
        light += worse.noise * rng.standard_normal(light.shape)
    return np.clip(np.rint(light), 0.0, 255.0).astype(np.uint8)


def _plane(view: CameraView) -> tuple[FloatArray, FloatArray]:
    """Right and up where each pixel's ray meets the target's plane [m]."""
    rows, columns = view.shape_px
    row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
    rays = np.stack(
        [(column - 0.5 * (columns - 1)) / view.focal_px, (row - 0.5 * (rows - 1)) / view.focal_px, np.ones_like(row)],
        axis=-1,
    )
    line = rays @ view.axes()
    place = view.place_m()
    reach = -place[2] / np.minimum(line[..., 2], -1e-9)
    return place[0] + reach * line[..., 0], place[1] + reach * line[..., 1]


def _surface(target: Target, x: FloatArray, y: FloatArray, side_light: float) -> FloatArray:
    """Brightness of target, markers and tower without beam."""
    half_w, half_h = 0.5 * target.width_m, 0.5 * target.height_m
    light = np.full(x.shape, target.tower)
    grazed = (x > half_w + 0.2 * target.width_m) & (x < half_w + 0.35 * target.width_m)
    light[grazed] += side_light
    light[(np.abs(x) < half_w) & (np.abs(y) < half_h)] = target.white
    light[_markers(target, x, y)] = target.marker
    return light


def _markers(target: Target, x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
    found = np.zeros(x.shape, np.bool_)
    for cx, cy in target.marker_centres_m():
        found |= (np.abs(x - cx) < 0.5 * target.marker_m) & (np.abs(y - cy) < 0.5 * target.marker_m)
    return found


def _reflectance(target: Target, x: FloatArray, y: FloatArray) -> FloatArray:
    """How much of a beam comes back from each point: all from the target, a fifth from the tower."""
    on = (np.abs(x) < 0.5 * target.width_m) & (np.abs(y) < 0.5 * target.height_m)
    return np.asarray(np.where(_markers(target, x, y), 0.05, np.where(on, 1.0, 0.2)))


def _flux(beam: Beam, x: FloatArray, y: FloatArray) -> FloatArray:
    """Flux of a beam at points of the plane, one at its peak."""
    from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

    radius = 0.5 * beam.sun_rad * beam.distance_m
    blur = 2.0 * beam.slope_error_rad * beam.distance_m
    half = radius + 4.0 * blur + beam.mirror_m
    pitch = 2.0 * half / (_GRID - 1)
    u = (np.arange(_GRID) - _GRID // 2) * pitch
    square = (u[:, None] ** 2 + u[None, :] ** 2) / radius**2
    # limb darkening: 0.39 at the rim, quadratic in the cosine is not needed at this blur
    disc = np.where(square < 1.0, 1.0 - 0.5 * (1.0 - np.sqrt(np.maximum(1.0 - square, 0.0))), 0.0)
    side = 2 * round(0.5 * beam.mirror_m / pitch) + 1  # odd: an even filter would shift the image
    image = gaussian_filter(uniform_filter(disc, side), blur / pitch)
    c, s = np.cos(beam.turn_rad), np.sin(beam.turn_rad)
    dx, dy = x - beam.centre_m[0], y - beam.centre_m[1]
    along, across = (c * dx + s * dy) / beam.stretch, c * dy - s * dx
    place = np.stack([across, along]) / pitch + _GRID // 2
    return np.asarray(map_coordinates(image / image.max(), place, order=1, mode="constant"))


def _flare(shape_px: tuple[int, int]) -> FloatArray:
    """Veil that falls off from the upper right corner, and ghosts on the line through the middle; one at most."""
    rows, columns = shape_px
    row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
    down, left = row / rows, 1.0 - column / columns
    light = 0.5 * np.exp(-2.0 * np.hypot(down, left))
    for part, size in ((0.25, 0.05), (0.8, 0.08)):
        light += 0.5 * np.exp(-0.5 * ((down - part) ** 2 + (left - part) ** 2) / size**2)
    return np.asarray(light)
