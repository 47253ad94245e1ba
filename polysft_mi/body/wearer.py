"""A garment is put on a body: what of :mod:`onefit` a reconstruction needs. torch is loaded here
alone.
"""

from __future__ import annotations

import os
from importlib.util import find_spec

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.errors import require
from polyfit.mesh import edges_of
from polysft_mi.errors import InputError

from .carrier import Carrier
from .motion import BodyMotion, MeshMotion
from .on_mesh import on_mesh

_NETWORK_FPS = 30.0
_SMOOTHING = 0.05  # [m] over which a drape is smoothed, twice: its folds are not those of the cloth


def put_on(vertices: np.ndarray, faces: np.ndarray, motion: BodyMotion | MeshMotion) -> Carrier:
    """The :class:`Carrier` of a template of ``vertices`` (N, 3) [m] and ``faces`` (F, 3), which
    lies on the body at rest, in a ``motion``: the template's weights are those of OneFit, and what
    it is carried in is OneFit's simulation on the same motion, without its folds. Raises InputError
    where OneFit is not installed, and for a template that is no garment on this body.
    """
    require("torch", "anny")
    if isinstance(motion, MeshMotion):
        carrier, worn = on_mesh(vertices, faces, motion)
    else:
        carrier, worn = _on_joints(vertices, faces, motion)
    _drape(carrier, vertices, faces, worn)
    return carrier


def check_model(path: str) -> None:
    """Raise InputError where a file is none of a body of SMPL's family; where torch is not
    installed, where there is none.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such file of a body")
    if find_spec("torch"):
        import onefit

        onefit.SmplBody(path)


def _on_joints(vertices, faces, motion):
    """(the :class:`Carrier`, the simulated template (T, N, 3) [m, world])."""
    import torch

    import onefit
    from onefit.garment import OffBody
    from onefit.motion import check_ways

    smpl = onefit.SmplBody(motion.model) if motion.model else None
    draper = onefit.load(model=smpl)
    shape = None if motion.shape is None else torch.as_tensor(motion.shape).float()
    if smpl:
        shape = smpl.shape_of(motion.shape)
    body, translation = draper.model.body(shape), motion.translation
    if smpl:  # theirs leads from where their own root is
        translation = translation + smpl.root(shape) - body.joints[0].double().numpy()
    given = smpl or shape is not None
    try:
        made_for = body if given else None
        garment = onefit.Garment.of_mesh("template", vertices, faces, made_for=made_for)
    except OffBody as error:
        raise InputError(
            f"{motion.path}: the template does not lie on the body at rest: {error.why}; it is"
            " needed as it lies there, z up, facing -y (onefit.align brings a garment there)"
        ) from None
    seen = garment.render_mesh
    corners = garment.faces.numpy()[seen.face]
    weights = np.einsum(
        "nk,nkj->nj", seen.barycentric, garment.blend_weights.double().numpy()[corners]
    )
    carrier = Carrier(
        body.joints.double().numpy(),
        body.parents,
        body.rest_pose.double().numpy(),
        weights / weights.sum(1, keepdims=True),
        motion.poses,
        translation,
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
    upright, root = motion.upright, carrier.joints[0]
    poses = motion.poses.copy()
    poses[:, 0] = (upright * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    as_onefit = onefit.Motion(
        torch.as_tensor(poses).float(),
        torch.as_tensor(upright.apply(translation + root) - root).float(),
        motion.fps,
    )
    check_ways(motion.path, poses, as_onefit.translation.numpy(), motion.fps)
    worn = draper.simulate(garment, as_onefit, shape).render_vertices().astype(float)
    worn = upright.inv().apply(worn.reshape(-1, 3)).reshape(worn.shape)
    at = np.arange(len(motion.poses)) * (_NETWORK_FPS / motion.fps)
    before = np.minimum(at.astype(int), len(worn) - 1)
    after, part = np.minimum(before + 1, len(worn) - 1), (at - before)[:, None, None]
    return carrier, worn[before] * (1 - part) + worn[after] * part


def _drape(carrier, vertices, faces, worn):
    """A drape ``worn`` (T, N, 3) [m, world], without its folds, becomes part of what carries."""
    from onefit.garment import cotangent_laplacian, smoother

    at_rest = [carrier.maps(carrier.at(k)).back(x) for k, x in enumerate(worn)]
    area, stiffness = cotangent_laplacian(vertices, faces)
    smooth = smoother(area, stiffness, _SMOOTHING)
    carrier.draped = np.stack([smooth(smooth(x - vertices)) for x in at_rest])
    carried = np.stack([carrier.maps(carrier.at(k))(vertices) for k in range(len(worn))])
    a, b = edges_of(faces)[0].T
    carrier.lengths, smooth = (np.linalg.norm(x[:, a] - x[:, b], axis=2) for x in (worn, carried))
    in_folds = 1 - smooth / carrier.lengths  # a surface follows none of them, or all
    carrier.length_errors = np.abs(in_folds.mean(1)) / np.sqrt(12)
