"""
From a recording to mirror normals
==================================

Transmitters around the field send ranging tones; receivers on each mirror record the band as IQ. This is the whole way
from such a recording to the mirrors' normals, on a simulated one: then what is really there is known as well.
"""

# %%
# A site is a TOML file: transmitters, tones, mirrors with the places of their receivers, calibration receivers. Table 2
# of the paper, on a field of 100 m, comes with rfpose. ``changed`` gives the same site with other numbers: here four
# mirrors whose pivots are surveyed to 5 mm, and short frames.
import rfpose as rf

site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
site = site.changed(
    heliostat=site.heliostat[:4],
    radio={"frame_samples": 40_000},
    simulation={"frame_count": 6, "frame_interval_s": 1.0, "tone_snr_db": 35.0},
)
site = site.changed(heliostat={"pivot_sigma_m": 0.005})
site

# %%
# ``simulate`` is a recording like any other, its samples made when they are read. A real one comes from
# ``rf.open_recording``: rfpose-iq, Digital RF or SigMF. Ten carriers, each with its two sidebands:
recording = rf.simulate(site, seed=1)
figure = recording.plot(receiver_id="H01_r0")

# %%
# ``process`` measures the phases of all tones, takes the transmitters' own phases out with the calibration receivers,
# and solves each mirror's pose from all of its phases at once. What could not be measured is NaN, with its reason.
result = rf.process(recording)
result

# %%
# One row a frame and mirror, as a table of pandas:
result.to_pandas().head(4)

# %%
# And everything as arrays with labelled dimensions. Units and meaning are attributes; a status has its codes.
normals = result.to_xarray("poses")
normals["normal_enu"].sel(heliostat="H02", xyz="up")

# %%
# How far off are they, and how far need they be? The truth came with the simulation, and the bound is that of the noise
# that the recording has. Milliradians are of the mirror normal; the beam turns by twice as much.
evaluation = rf.evaluate(result)
evaluation

# %%
# The field from above: each mirror with its normal, in the colour of its error.
figure = result.plot(evaluation=evaluation)

# %%
# ``result.save("result.h5")`` writes the file that ``rfpose process`` writes; ``rf.open_result`` and xarray open it.
import tempfile
from pathlib import Path

import xarray as xr

path = Path(tempfile.mkdtemp()) / "result.h5"
result.save(path)
xr.open_dataset(path, engine="h5netcdf", group="fixes")["position_enu_m"].sizes
