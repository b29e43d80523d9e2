"""A camera that shifted is not given a rotation instead."""

from types import SimpleNamespace

import numpy as np
import pytest

from rigwake.errors import UnobservableError
from rigwake.monitor import recalibration
from rigwake.monitor.blame import Explanation
from rigwake.monitor.judge import Alarm
from rigwake.monitor.recalibration import recalibrate


def test_a_shift_that_the_rest_does_not_show_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    shift = Explanation("translation", "left", np.array([0.03, 0, 0]), np.eye(3), 30.0)
    judgement = SimpleNamespace(
        alarms=(Alarm(6, 4, "", (shift,)),),
        scores=SimpleNamespace(starts_ns=np.arange(10, dtype=np.int64) * 10**10),
    )
    result = SimpleNamespace(judgement=judgement, monitored=SimpleNamespace(rig=None), motion=None, tracks={})
    refined = np.zeros(3), np.eye(3) * 1e-10, None
    monkeypatch.setattr(recalibration, "refined_step", lambda *_: refined)
    monkeypatch.setattr(recalibration, "_from_others", lambda *_: np.zeros((3, 3)))
    monkeypatch.setattr(recalibration, "_shift", lambda *_: None)
    with pytest.raises(UnobservableError, match="left shifted"):
        recalibrate(SimpleNamespace(), result)  # type: ignore[arg-type]
