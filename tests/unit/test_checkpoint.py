"""When the state of a long simulation is kept."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.pipeline.formats.checkpoint import Checkpoint


@pytest.mark.parametrize(("share", "kept"), [(0.0, None), (1e-9, 0), (1e9, 2)])
def test_what_cost_long_is_kept_at_once(tmp_path: Path, share: float, kept: int | None) -> None:
    """The first writing takes nearly no time for all that is known; the second as long as the first has taken."""
    place = tmp_path / "state"
    checkpoint = Checkpoint(place, {}, restart=False, interval_s=1e9)
    for i in range(3):
        checkpoint.write({"i": np.array(i)}, share=share)
    state = Checkpoint(place, {}, restart=False).read()
    assert (None if state is None else int(state["i"])) == kept
