"""Warp, started without its report of devices and caches."""

import os
import sys
from functools import lru_cache


@lru_cache
def warp():
    """The module ``warp``, ready. What it writes at its start, from native code too, is left out;
    its errors are not.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)
    return wp
