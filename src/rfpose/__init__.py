"""rfpose measures where mirrors point, by radio.

The names below are the public face, each a verb that takes objects or paths and gives an object::

    import rfpose as rf

    site = rf.load_scenario("site.toml")
    recording = rf.simulate(site, seed=1)  # or rf.open_recording("night.h5")
    result = rf.process(recording)
    rf.evaluate(result).normal_error_mrad.rms
    result.save("result.h5")

They are loaded when they are first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rfpose.pipeline.calibrate import calibrate
    from rfpose.pipeline.demo import shipped_scenario
    from rfpose.pipeline.evaluate import evaluate
    from rfpose.pipeline.formats.result_file import open_result
    from rfpose.pipeline.formats.track_file import open_track
    from rfpose.pipeline.layout import budget, layout_map, optimise
    from rfpose.pipeline.learn import learn_pattern
    from rfpose.pipeline.process import process
    from rfpose.pipeline.publish import publish
    from rfpose.pipeline.simulate import simulate
    from rfpose.pipeline.survey import survey
    from rfpose.pipeline.track import track
    from rfpose.recording import open_recording
    from rfpose.scenario import load_scenario

__version__ = "0.1.0"

__all__ = [
    "budget",
    "calibrate",
    "evaluate",
    "layout_map",
    "learn_pattern",
    "load_scenario",
    "open_recording",
    "open_result",
    "open_track",
    "optimise",
    "process",
    "publish",
    "shipped_scenario",
    "simulate",
    "survey",
    "track",
]

_HOME = {
    "budget": "pipeline.layout",
    "calibrate": "pipeline.calibrate",
    "evaluate": "pipeline.evaluate",
    "layout_map": "pipeline.layout",
    "learn_pattern": "pipeline.learn",
    "load_scenario": "scenario",
    "open_recording": "recording",
    "open_result": "pipeline.formats.result_file",
    "open_track": "pipeline.formats.track_file",
    "optimise": "pipeline.layout",
    "process": "pipeline.process",
    "publish": "pipeline.publish",
    "shipped_scenario": "pipeline.demo",
    "simulate": "pipeline.simulate",
    "survey": "pipeline.survey",
    "track": "pipeline.track",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rfpose' has no attribute {name!r}")
    return getattr(import_module(f"rfpose.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
