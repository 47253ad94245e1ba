"""A garment is put on a body: what of :mod:`onefit` a reconstruction needs. torch is loaded here
alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from polyfit.errors import require
from polyfit.mesh import edges_of

from .carrier import Carrier

if TYPE_CHECKING:
    from .motion import BodyMotion

_NETWORK_FPS = 30.0
_SMOOTHING = 0.05  # [m] over which a drape is smoothed, twice: its folds are not those of the cloth


def put_on(vertices: np.ndarray, faces: np.ndarray, motion: BodyMotion) -> Carrier:
    """The :class:`Carrier` of a template of ``vertices`` (N, 3) [m] and ``faces`` (F, 3), which
    lies on the body at rest, in a ``motion``: the template's weights are those of OneFit, and what
    it is carried in is OneFit's simulation on the same motion, without its folds. Raises InputError
    where OneFit is not installed, and for a template that is no garment on this body.
    """
    require("torch", "anny")
    import torch

    import onefit
    from onefit.garment import cotangent_laplacian, smoother

    draper = onefit.load()
    shape = None if motion.shape is None else torch.as_tensor(motion.shape).float()
    body = draper.model.body(shape)
    garment = onefit.Garment.of_mesh(
        "template", vertices, faces, made_for=None if shape is None else body
    )
    seen = garment.render_mesh
    corners = garment.faces.numpy()[seen.face]
    weights = np.einsum(
        "nk,nkj->nj", seen.barycentric, garment.blend_weights.double().numpy()[corners]
    )
    as_onefit = onefit.Motion(
        torch.as_tensor(motion.poses).float(),
        torch.as_tensor(motion.translation).float(),
        motion.fps,
    )
    carrier = Carrier(
        body.joints.double().numpy(),
        body.parents,
        body.rest_pose.double().numpy(),
        weights / weights.sum(1, keepdims=True),
        motion.poses,
        motion.translation,
        fps=motion.fps,
        skin=tuple(
            x.numpy().astype(kind)
            for x, kind in (
                (body.vertices, float),
                (body.blend_weights, float),
                (body.faces, np.int64),
            )
        ),
    )
    worn = draper.simulate(garment, as_onefit, shape).render_vertices().astype(float)
    at = np.arange(len(motion.poses)) * (_NETWORK_FPS / motion.fps)
    before = np.minimum(at.astype(int), len(worn) - 1)
    after, part = np.minimum(before + 1, len(worn) - 1), (at - before)[:, None, None]
    worn = worn[before] * (1 - part) + worn[after] * part
    at_rest = [carrier.maps(carrier.at(k)).back(x) for k, x in enumerate(worn)]
    area, stiffness = cotangent_laplacian(vertices, faces)
    smooth = smoother(area, stiffness, _SMOOTHING)
    carrier.draped = np.stack([smooth(smooth(x - vertices)) for x in at_rest])
    # a surface follows about half of its folds
    carried = np.stack([carrier.maps(carrier.at(k))(vertices) for k in range(len(worn))])
    a, b = edges_of(faces)[0].T
    each = [np.linalg.norm(x[:, a] - x[:, b], axis=2) for x in (worn, carried)]
    carrier.lengths = (each[0] + each[1]) / 2
    return carrier
