"""Arrays on the device."""

import mitsuba as mi
import numpy as np
import pytest

from polyfit.device import on_device


@pytest.mark.parametrize("kind", ["Float", "Float64", "UInt32", "Int32"])
def test_arrays_reach_the_device_as_copies(kind):
    for start in range(5):  # at any place in memory
        values = np.arange(40)[start:].reshape(-1, 1) * 3
        found = on_device(values[:, 0], getattr(mi, kind))
        values[:] = -1
        assert np.array_equal(np.array(found), np.arange(40)[start:] * 3) and isinstance(
            found, getattr(mi, kind)
        )
