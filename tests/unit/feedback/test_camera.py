"""Pictures in, spots out: accuracy on rendered pictures, and a reason for each picture that tells nothing."""

import sys

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.calibration import FitSettings, fit_many
from rfpose.feedback.camera.malan import Board, beam_threshold, find_spot, marker_threshold, weighted_centroid
from rfpose.feedback.camera.model import camera_measurements, spots_enu_m
from rfpose.feedback.camera.render import Beam, CameraView, PictureFlaws, Target, project_px, render
from rfpose.feedback.camera.search import neighbour_zones_m, search, spiral_offsets_m
from rfpose.feedback.camera.spot import SpotStatus, read_picture
from rfpose.feedback.mount import Mount

pytest.importorskip("skimage", reason="pictures need scikit-image")

TARGET, VIEW = Target(), CameraView()


def picture(*centres, seed=0, target=TARGET, view=VIEW, worse=None, **beam):
    beams = tuple(Beam(centre_m=centre, **beam) for centre in centres)
    return render(target, view, beams, disturbance=worse, rng=np.random.default_rng(seed))


def test_thresholds_and_centroid():
    # M10, (5.2) to (5.4)
    assert marker_threshold(10.0, 200.0) == 50.0
    assert beam_threshold(100.0, 200.0) == 150.0
    image = np.array([[0.0, 0, 0], [0, 1, 3], [0, 0, 0]])
    assert weighted_centroid(image, image > 0).tolist() == [1.75, 1.0]
    assert Board().mm_per_px == pytest.approx(6.67, abs=0.005)


def test_centroids_of_clean_pictures_are_good_to_a_fraction_of_a_pixel():
    rng = np.random.default_rng(1)
    error = []
    for i in range(12):
        true = rng.uniform(-0.45, 0.45, 2)
        view = CameraView(right_m=rng.uniform(-8, 8), up_m=-11.0, roll_rad=rng.uniform(-0.03, 0.03))
        found = find_spot(picture(tuple(true), seed=i, view=view))
        assert found.status == SpotStatus.OK, found.text
        np.testing.assert_allclose(found.centre_px, project_px(view, true), atol=1.5)
        error.append(found.centre_m - true)
    # a pixel of 6.67 mm
    assert 1e3 * np.sqrt(np.mean(np.sum(np.square(error), axis=1))) < 3.5


def test_markers_beat_no_perspective():
    # half the picture's perspective would cost centimetres: the chain must use it
    view = CameraView(right_m=25.0, up_m=-15.0)
    found = find_spot(picture((0.5, 0.5), view=view))
    np.testing.assert_allclose(found.centre_m, [0.5, 0.5], atol=8e-3)


@pytest.mark.parametrize(
    ("worse", "limit_mm"),
    [(PictureFlaws(noise=6.0), 6.0), (PictureFlaws(side_light=140.0), 6.0), (PictureFlaws(flare=30.0), 25.0)],
    ids=["noise", "side-light", "flare"],
)
def test_disturbances(worse, limit_mm):
    found = find_spot(picture((0.2, -0.3), worse=worse))
    assert found.status == SpotStatus.OK, found.text
    assert 1e3 * np.linalg.norm(found.centre_m - [0.2, -0.3]) < limit_mm


def test_shape_of_the_beam_does_not_matter():
    for beam in ({"stretch": 1.6, "turn_rad": 0.7}, {"slope_error_rad": 0.5e-3}, {"mirror_m": 0.8}):
        found = find_spot(picture((-0.1, 0.2), **beam))
        np.testing.assert_allclose(found.centre_m, [-0.1, 0.2], atol=5e-3)


BAD = {
    "none": (lambda: picture(), SpotStatus.NO_SPOT),
    "two": (lambda: picture((-0.45, 0.3), (0.5, -0.3)), SpotStatus.TWO_SPOTS),
    "saturated": (lambda: picture((0.0, 0.0), level=900.0), SpotStatus.SATURATED),
    "over the edge": (lambda: picture((0.95, 0.1)), SpotStatus.OFF_TARGET),
    "off the target": (lambda: picture((2.5, 0.0)), SpotStatus.NO_SPOT),
    "no markers": (lambda: picture((0.0, 0.0), target=Target(marker_m=0.0)), SpotStatus.NO_MARKERS),
    "marker out of view": (lambda: picture((0.0, 0.0), view=CameraView(aim_m=(1.2, 0.0))), SpotStatus.NO_MARKERS),
    "small": (lambda: picture((0.0, 0.0))[:30], SpotStatus.WRONG_SIZE),
    "black": (lambda: np.zeros((300, 375), np.uint8), SpotStatus.NO_MARKERS),
}


@pytest.mark.parametrize("case", BAD)
def test_a_picture_that_tells_nothing_says_why(case):
    make, status = BAD[case]
    found = find_spot(make())
    assert found.status == status, found.text
    assert found.text
    assert np.isnan(found.centre_m).all()


def test_another_size_than_expected():
    found = find_spot(picture((0.0, 0.0)), Board(shape_px=(576, 768)))
    assert found.status == SpotStatus.WRONG_SIZE
    assert "300 x 375" in found.text


def test_picked_corners_help_where_other_marks_are_in_view():
    image = picture((0.1, 0.1)).copy()
    image[5:17, 5:17] = 8  # another dark square, further out
    corners = tuple(map(tuple, project_px(VIEW, TARGET.marker_centres_m())))
    found = find_spot(image, Board(corners_px=corners))
    np.testing.assert_allclose(found.centre_m, [0.1, 0.1], atol=5e-3)


def test_pictures_from_files(tmp_path):
    from skimage import io

    grey = picture((0.25, -0.15))
    io.imsave(tmp_path / "grey.png", grey, check_contrast=False)
    io.imsave(tmp_path / "colour.png", np.stack([grey] * 3, axis=-1), check_contrast=False)
    for name in ("grey.png", "colour.png"):
        np.testing.assert_allclose(find_spot(read_picture(tmp_path / name)).centre_m, [0.25, -0.15], atol=5e-3)
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\nnot really")
    with pytest.raises(RecordingError, match="no picture that can be read"):
        read_picture(tmp_path / "bad.png")
    with pytest.raises(RecordingError, match="no such picture"):
        read_picture(tmp_path / "none.png")


def test_without_scikit_image(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(InvalidInputError, match="pip install 'scikit-image>="):
        find_spot(picture((0.0, 0.0)))


# ---- searches -----------------------------------------------------------------------------------------------------


def test_spiral_steps_by_half_the_target():
    # M11
    way = spiral_offsets_m(2.0, n_ring=3)
    assert len(way) == 49
    assert len(np.unique(way, axis=0)) == 49
    np.testing.assert_allclose(np.linalg.norm(np.diff(way, axis=0), axis=1), 1.0)
    ring = np.abs(way).max(axis=1)
    assert np.all(np.diff(ring) >= 0.0)
    assert spiral_offsets_m(2.0, n_ring=0).tolist() == [[0.0, 0.0]]


def test_spiral_finds_a_beam_in_pictures():
    off = np.array([3.3, -2.6])

    def look(offset):
        return find_spot(picture(tuple(off + offset))).status == SpotStatus.OK

    found = search(look, spiral_offsets_m(2.0, n_ring=4))
    assert found.seen
    assert np.abs(off + found.offset_m).max() < 0.9
    assert 20 < found.n_look <= 81
    nothing = search(lambda offset: False, spiral_offsets_m(2.0, n_ring=1))
    assert not nothing.seen
    assert nothing.n_look == 9


def test_zones_begin_where_the_beam_was_last_seen():
    zones = neighbour_zones_m(14.0, 10.0)
    assert len(zones) == 8
    assert np.abs(zones).max(axis=0).tolist() == [14.0, 10.0]
    assert neighbour_zones_m(14.0, 10.0, last_seen_m=(-6.0, 4.5))[0].tolist() == [-14.0, 10.0]


# ---- without pictures ---------------------------------------------------------------------------------------------


def test_many_heliostats_without_pictures():
    rng = np.random.default_rng(4)
    start = [Mount(pivot_enu_m=np.array([x, 80.0, 3.0])) for x in (-40.0, 0.0, 40.0)]
    true = [mount.replace(axis_1_zero_rad=0.004, axis_2_zero_rad=-0.003) for mount in start]
    sun = geometry.enu_from_azimuth_elevation(rng.uniform(2.0, 4.3, 200), rng.uniform(0.3, 1.1, 200))
    made = camera_measurements(
        true, sun_enu=sun, target_enu_m=[0.0, 0.0, 40.0], rng=rng, steering=start, spot_sigma_m=0.02
    )
    assert np.linalg.norm(made[0].row[:, 4:7] - [0.0, 0.0, 40.0], axis=1).mean() > 0.3
    found = fit_many(start, made, free="offsets", settings=FitSettings(sigma_known=True, huber=np.inf))
    pull = (found.estimate - [0.004, -0.003]) / found.sigma
    assert np.abs(pull).max() < 4.0
    residual = fit_many(start, made, free="offsets")
    np.testing.assert_allclose(residual.noise, 1.0, atol=0.25)


def test_right_and_up_of_a_target_in_the_site():
    place = spots_enu_m([[1.0, 2.0]], target_enu_m=[0.0, 5.0, 40.0], target_normal_enu=[0.0, 1.0, 0.0])
    np.testing.assert_allclose(place, [[-1.0, 5.0, 42.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CameraView(front_m=-1.0), "front_m"),
        (lambda: CameraView(shape_px=(1, 5)), "shape_px"),
        (lambda: Board(mm_per_px=0.0), "mm_per_px"),
        (lambda: Board(corners_px=((0.0, 0.0),)), r"shape \(4, 2\)"),
        (lambda: find_spot(np.zeros(5)), "row, column"),
        (lambda: find_spot(np.zeros((50, 50), np.int64)), "8 or 16 bits"),
        (lambda: spiral_offsets_m(0.0, n_ring=1), "side_m"),
        (lambda: spiral_offsets_m(1.0, n_ring=-1), "n_ring"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()
