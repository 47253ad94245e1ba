"""Work of many equal pieces, in two threads."""

from concurrent.futures import ThreadPoolExecutor


class Halves:
    """Calls of a function for both halves of a range, at once: one in another thread, which is kept
    for the next call, and one in the caller's, which so need not wake a second.
    """

    def __init__(self):
        self._pool = ThreadPoolExecutor(1)

    def __call__(self, function, count):
        """``function(0, middle)`` and ``function(middle, count)``, a pair."""
        first = self._pool.submit(function, 0, count // 2)
        second = function(count // 2, count)
        return first.result(), second
