"""Arrays on the device that Dr.Jit computes on. Import only after a Mitsuba variant is set."""

import drjit as dr
import numpy as np

_ALIGNED = 64  # bytes: what kernels take for granted of memory, or are recorded again for
_NUMPY = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32,
    dr.VarType.Int32: np.int32,
}


def on_device(array, kind):
    """A NumPy array, flat, as a Dr.Jit array of type ``kind``, or points (N, 3) as a Point3f, or
    another type of three; a copy.

    Dr.Jit takes NumPy's memory as it is, and kernels say how that is aligned: by chance, so that
    kernels in the cache would be others in each run.
    """
    array = np.asarray(array)
    if dr.depth_v(kind) > 1:
        return kind(*(on_device(x, dr.value_t(kind)) for x in array.T))
    scalar = np.dtype(_NUMPY[dr.type_v(kind)])
    room = np.empty(array.size * scalar.itemsize + _ALIGNED, np.uint8)
    skipped = -room.ctypes.data % _ALIGNED
    out = room[skipped : skipped + array.size * scalar.itemsize].view(scalar)
    out.reshape(array.shape)[...] = array
    return kind(out)
