"""A sleeve on an arm of two bones, for tests of bodies; it needs no OneFit."""

import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.body import Carrier

PARENTS = (-1, 0)


def arm(vertices, bend, translation, draped=None, faces=((0, 1, 2),)):
    """The :class:`Carrier` of a sleeve along x (N, 3) [m] on an arm whose elbow, at the sleeve's
    middle, bends by ``bend`` (T,) [rad] about z; ``translation`` (T, 3) [m]. Its skin is the
    sleeve's own, with ``faces``.
    """
    low, high = vertices[:, 0].min(), vertices[:, 0].max()
    middle = vertices.mean(0)
    joints = np.stack([(low, *middle[1:]), middle])
    far = np.clip(0.5 + 4 * (vertices[:, 0] - middle[0]) / (high - low), 0, 1)
    weights = np.stack([1 - far, far], 1)
    poses = np.zeros((len(bend), 2, 3))
    poses[:, 1, 2] = bend
    skin = vertices, weights, np.asarray(faces)
    rest = np.zeros((2, 3))
    return Carrier(joints, PARENTS, rest, weights, poses, translation, draped=draped, skin=skin)


def some_pose(carrier, rng, frame=1, size=0.05):
    """A pose of a frame, off by about ``size`` [rad] and a third of it [m]."""
    step = size * rng.normal(size=len(carrier))
    step[-3:] /= 3
    return carrier.at(frame, step)


def turned(bend):
    """A rotation about z by ``bend`` [rad]."""
    return Rotation.from_rotvec([0, 0, bend]).as_matrix()
