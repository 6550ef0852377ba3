"""
A day of tracking, methods compared
===================================

What does knowing the normals buy? A field is tracked from stow to stow, by radio and by what plants do today, all of
them on the same sun, wind and hidden errors of the mounts.
"""

# %%
# The scenario's ``[tracking]`` table says what mounts, drives, wind, radio and cameras are like. So that this page is
# made in seconds, the day here has three hours, and the field three mirrors. At noon the field is sent away for half an
# hour.
import rfpose as rf

site = rf.load_scenario(rf.shipped_scenario("tracking_100m.toml"))
events = [{"hour": 12.0, "what": "emergency"}, {"hour": 12.5, "what": "release"}]
day = rf.track(
    site.changed(tracking={"first_hour": 10.5, "last_hour": 13.5, "event": events}),
    methods=["open-loop", "camera-model", "radio-both"],
    heliostats=3,
    seed=1,
)
day

# %%
# Errors in the course of the day, light on the receiver, what the mirrors are doing, and how the mirrors differ.
figure = day.plot()

# %%
# What a method did, with labelled dimensions: here the error of each mirror whose course is kept, averaged by hour.
radio = day.to_xarray("radio-both")
(1e3 * radio["error_rad"]).groupby("time.hour").mean().round(2)

# %%
# One row a method and mirror:
scores = day.to_pandas()
scores.groupby("method", sort=False)[["normal_rms_mrad", "intercept"]].mean().round(4)

# %%
# Whether radio is worth it is decided by the light that is caught; the mirrors' errors decide that.
from rfpose.drawing import new_figure

figure, axes = new_figure(7.0, 3.2)
for name, rows in scores.groupby("method", sort=False):
    axes.plot(rows["heliostat"], rows["normal_rms_mrad"], "o-", label=name)
axes.set_yscale("log")
axes.set_ylabel("normal error, rms [mrad]")
axes.legend()
axes.grid(alpha=0.3)
