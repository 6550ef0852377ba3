"""
A layout study from a table of heliostats
=========================================

Before anything is built: how well could the normals of *these* heliostats be known, where does their error come from,
and where should the transmitters stand? Geometry and noise say so without a single sample.
"""

# %%
# The field is a CSV file with the columns ``id, east_m, north_m, up_m``. This one is radially staggered about a tower.
import tempfile
from pathlib import Path

import numpy as np

import rfpose as rf
from rfpose.layout.fields import radial_staggered

table = Path(tempfile.mkdtemp()) / "field.csv"
places = radial_staggered(90, first_radius_m=18.0, diagonal_m=7.0, height_m=2.0)
rows = [f"M{k:03d},{east:.2f},{north:.2f},{up:.2f}" for k, (east, north, up) in enumerate(places)]
table.write_text("\n".join(["id,east_m,north_m,up_m", *rows]))

# %%
# ``with_field`` puts it in place of the scenario's, each heliostat with the mirror of the scenario's first.
site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml")).with_field(table)
site

# %%
# The map: what each normal can be known to, the sun in the south at noon. Estimator ``rigid`` solves a mirror's pose
# from the tones of its three receivers, ``scenario`` is that of ``process`` with all that the scenario knows.
found = rf.layout_map(site, estimators=["rigid", "scenario"], suns_deg=[(180.0, 50.0)])
found

# %%
figure = found.plot()

# %%
# One row a heliostat; ``found.save("map.csv")`` writes it.
found.to_pandas()[["id", "pdop", "normal_rigid_rms_mrad"]].describe().round(3)

# %%
# Where would the error come from? Each source to first order, worst first; noise is not the worst of them.
sources = rf.budget(site, n_draw=0)
sources

# %%
figure = sources.plot()

# %%
# Better places for the transmitters, within the circle that they span now and as high as 40 m. A few starts are enough
# for a picture; leave ``starts`` at its default for a plant.
from rfpose.pipeline.layout import Rules

better = rf.optimise(site, criterion="rigid", rules=Rules(height_m=(15.0, 40.0)), starts=2)
better

# %%
after = rf.layout_map(better.scenario, estimators=["rigid"], suns_deg=[(180.0, 50.0)])
figure = after.plot()

# %%
before_mrad, after_mrad = found.rms_mrad["rigid"], after.rms_mrad["rigid"]
f"rms over the field: {np.sqrt(np.mean(before_mrad**2)):.3f} mrad before, {np.sqrt(np.mean(after_mrad**2)):.3f} after"
