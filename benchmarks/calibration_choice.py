"""Print how well chosen parameters predict against fixed sets, for each heliostat of a PAINT directory.

    python benchmarks/calibration_choice.py PAINT [--heliostat ID ...] [--splits 20] [--subsets 4]

Median error of the mirror normal of what was held out [mrad]: random 60 % fitted, mean of the splits; and the earlier
60 % fitted, the later judged. With all records, and with 26 of them: evenly spread over time, mean of several such
subsets. `inside`: share of the later errors within the RMS that the fit forecasts, noise included; 63 % if honest.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.feedback.calibration import fit, predict
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount
from rfpose.feedback.paint import heliostat_ids, read_heliostat
from rfpose.feedback.selection import AUTO, fit_chosen
from rfpose.feedback.validation import chronological_split, random_splits

SETS = ("level-4", "level-full", AUTO)
FEW = 26


def subsets(made: Measurements, n_subset: int) -> Iterator[Measurements]:
    """Few records, evenly over time, each subset begun a little later."""
    order = np.argsort(made.unix_s, kind="stable")
    step = len(order) / FEW
    for start in np.arange(n_subset) * step / n_subset:
        yield made.take(order[(start + step * np.arange(FEW)).astype(int)])


def judge(mount: Mount, made: Measurements, free: str, n_split: int) -> tuple[float, float, float]:
    """Medians of random splits and of the later part [mrad], and the share of the later part within one sigma."""
    random = random_splits(mount, made, free=free, rng=np.random.default_rng(0), n_split=n_split)
    later = chronological_split(mount, made, free=free)
    medians = (1e3 * float(random.test_median_rad.mean()), 1e3 * float(later.test_median_rad[0]))
    return *medians, inside(mount, made, later.is_train[0], free)


def inside(mount: Mount, made: Measurements, early: npt.NDArray[np.bool_], free: str) -> float:
    """Share of the errors of the normal of what is not early that lie within the RMS that its fit forecasts."""
    part = made.take(early)
    found = fit_chosen(mount, part) if free == AUTO else fit(mount, part, free=free)
    ahead = predict(found, made.take(~early))
    total = np.sqrt(ahead.sigma_rad**2 + 2.0 * found.noise_rad**2)
    known = np.isfinite(ahead.error_rad)
    return float(np.mean(ahead.error_rad[known] < total[known]))


def main() -> None:
    """Print one line a heliostat, number of records and set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paint", type=Path)
    parser.add_argument("--heliostat", nargs="*", default=())
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--subsets", type=int, default=4)
    options = parser.parse_args()
    print(f"{'heliostat':10}{'records':>8}  {'parameters':12}{'random':>8}{'later':>8}{'inside':>8}")
    for name in options.heliostat or heliostat_ids(options.paint):
        data = read_heliostat(options.paint, name)
        whole = Measurements.from_spots(
            data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.order_s
        )
        few = list(subsets(whole, options.subsets)) if len(whole) > FEW else []
        for parts in filter(None, ([whole], few)):
            for free in SETS:
                told = np.mean([judge(data.mount, part, free, options.splits) for part in parts], axis=0)
                print(f"{name:10}{len(parts[0]):8}  {free:12}{told[0]:8.3f}{told[1]:8.3f}{told[2]:8.2f}", flush=True)


if __name__ == "__main__":
    main()
