"""Functions on the device that Dr.Jit computes on: recorded, interrupted, on a share of the cores.
Import only after a Mitsuba variant is set.
"""

import contextlib
import functools
import gc

import drjit as dr

from polyfit.backend import cores

# recordings of one function: with and without shading, and where arrays happen to be of one size
_WARN_AFTER = 64


def frozen(function):
    """A function of Dr.Jit arrays, whose kernels are recorded once for each kind of arguments and
    launched again without tracing.

    A replayed kernel has the size of the largest array that it reads elementwise; one that only
    gathers from arrays, and arrays that are made to be scattered to, keep the size that was
    recorded. So where the sizes of arguments change, every kernel whose size follows them must read
    one of that size elementwise, and nothing of such a size may be made inside, or it is written
    beyond its end.
    """
    recorded = dr.freeze(function, warn_after=_WARN_AFTER)

    @functools.wraps(function)
    def call(*arguments):
        collecting = gc.isenabled()
        # arrays of others that are freed in the middle of a recording would be part of it, and the
        # process would abort
        gc.disable()
        try:
            return recorded(*arguments)
        finally:
            if collecting:
                gc.enable()

    call.recorded = recorded
    return call


@contextlib.contextmanager
def interruptible():
    """Ctrl-C in the middle of a loop or a recording, which Dr.Jit makes a RuntimeError, is
    KeyboardInterrupt again.
    """
    try:
        yield
    except RuntimeError as error:
        cause = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            cause = cause.__cause__ or cause.__context__
        raise


@contextlib.contextmanager
def threads(share):
    """Let Dr.Jit use this share of the cores meanwhile.

    Short kernels, as those of the second-order solver, run as fast on half of them: with a thread a
    processor, threads mostly wait for each other, and none is left to draw.
    """
    before = dr.thread_count()
    dr.set_thread_count(max(1, int(share * cores())))
    try:
        yield
    finally:
        dr.set_thread_count(before)
