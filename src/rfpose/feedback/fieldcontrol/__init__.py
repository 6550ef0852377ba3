"""Field control: messages, buses, modes and emergencies of up to ten thousand heliostats.

`control.ControlledField` is what a simulation steps. Each servo step::

    control = FieldControl(aim_enu_m=aim, pivot_enu_m=pivot, mode=Mode.TRACK, rng=rng)
    control.command(Event.DEFOCUS, [3, 7])               # any time; answers who is refused, and why
    orders = control.step(t, axis_rad=axis, aim_axis_rad=aim_axis, sun_enu=sun, wind_mps=wind, feedback_valid=ok)

``orders.mode`` is the `modes.Mode` of each heliostat. ``orders.target_axis_rad`` says where its axes shall go at full
speed; it is NaN where the heliostat follows ``orders.aim_enu_m`` and the caller's controller steers, by
``orders.sun_enu`` as last heard over the bus. The caller moves the axes (`motion.move_axes` does it with a limited
rate) and gives back in the next step what the step counters say (``axis_rad``) and where the axes would have to be
for the aim (``aim_axis_rad``, for the approach from stow). ``control.state()`` and ``control.restore()`` let a
killed run go on.

Modules: ``packets`` twelve-byte messages, ``bus`` polled buses and their faults, ``modes`` the table of modes,
``diagram`` its picture, ``control`` the field, ``motion`` axes, ``emergency`` a whole field's emergency with the flux
that is left on the receiver.
"""
