"""The classical closed forms are right without noise, so that comparing with them is fair."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from closed_forms import CLOSED_FORMS
from geometry_strategies import transforms
from rigwake.geometry.se3 import SE3
from rigwake.handeye.initial_mounting import linear_handeye

SOLVERS = {**CLOSED_FORMS, "thesis": linear_handeye}


@pytest.mark.parametrize("name", SOLVERS)
@given(mounting=transforms(), seed=st.integers(0, 2**31))
@settings(max_examples=15)
def test_exact_without_noise(name, mounting, seed):
    rng = np.random.default_rng(seed)
    B = SE3.exp(rng.normal(size=(20, 6)) * np.repeat([0.5, 1.0], 3))
    found = SOLVERS[name](mounting * B * mounting.inverse(), B)
    size = max(1.0, float(np.linalg.norm(mounting.translation)))
    assert np.abs(mounting.local(found)).max() < 1e-5 * size
