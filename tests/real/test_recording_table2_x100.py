"""The Digital RF recording made by independent code reads as its description says."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfpose.recording import convert, describe, frame_starts, open_recording

pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "recordings" / "table2_x100"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is absent")
START = 1_790_000_000 * 40_000_000


def test_reads_as_described():
    about = json.loads((DATA / "description.json").read_text())
    with open_recording(DATA / "drf") as r:
        assert r.format == "digital-rf"
        assert r.receiver_ids == ("H000_r0", "H000_r1", "H000_r2", "cal0")
        assert r.sample_rate == about["sample_rate_hz"]
        assert r.sample_format == "int16"
        assert r.full_scale == about["full_scale_counts"]
        for name in r.receiver_ids:
            assert r.blocks(name).tolist() == [[START, about["samples"]]]
        assert frame_starts(r, 100_000).tolist() == [START + k * 100_000 for k in range(4)]
        summary = describe(r)
    assert summary["problems"] == []
    assert all(entry["clipped_fraction"] == 0.0 for entry in summary["receivers"].values())


def test_ten_carriers_stand_out():
    about = json.loads((DATA / "description.json").read_text())
    carriers = np.array([t["carrier_hz"] for t in about["transmitters"]])
    with open_recording(DATA / "drf") as r:
        iq = r.read("cal0", START, 400_000)
    spectrum = np.abs(np.fft.fft((iq[:, 0] + 1j * iq[:, 1]) * np.hanning(400_000)))
    frequency = np.fft.fftfreq(400_000, 1 / about["sample_rate_hz"])
    floor = np.median(spectrum)
    for carrier in carriers:  # ten ppm of 100 MHz is 1 kHz: ten bins
        assert spectrum[np.abs(frequency - carrier) < 1_500].max() > 100 * floor


def test_conversion_keeps_it(tmp_path):
    with open_recording(DATA / "drf") as source:
        convert(source, tmp_path / "native.h5", format="rfpose-iq")
        with open_recording(tmp_path / "native.h5") as got:
            for name in source.receiver_ids:
                assert np.array_equal(got.read(name, START, 400_000), source.read(name, START, 400_000))
