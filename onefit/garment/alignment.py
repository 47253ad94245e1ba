"""Garments of CLOTH3D, aligned with the standard body (paper, supplement, "Garment preprocessing").

In: a garment around a body of any shape, which stands in its dataset's pose. Out: the same mesh
around the standard body in the T-pose, which :meth:`onefit.Garment.read` takes with
``made_for="T-pose"``.
"""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from onefit.body import Body, skeleton
from polyfit import mesh
from polyfit.errors import InputError

from .binding import standard_body, surface_of
from .fitting import Place, check_place, in_pose, lowered_stand, standard_on
from .reading import check

_CLOTH3D_HIPS = 0.15  # [rad] by which each leg stands aside in CLOTH3D's rest pose
POSES = ("cloth3d", "T-pose")


def pose_of(name: str) -> torch.Tensor:
    """The pose (24, 3) [rad] called ``name``, one of :data:`POSES`. Raises InputError for others.

    CLOTH3D's garments rest on a body in the T-pose whose legs stand apart, each by 0.15 rad about
    the axis that points to the front.
    """
    if name not in POSES:
        raise InputError(f"pose '{name}': choose {' or '.join(POSES)}")
    pose = torch.zeros(len(skeleton.JOINTS), 3)
    if name == "cloth3d":
        pose[skeleton.INDEX["left_hip"], 1] = -_CLOTH3D_HIPS
        pose[skeleton.INDEX["right_hip"], 1] = _CLOTH3D_HIPS
    return pose


def wearer(body: Body, pose: torch.Tensor) -> Body:
    """``body``, which rests in the standard stand, in ``pose`` (24, 3) [rad], with the vertices and
    faces of the standard body laid onto it.
    """
    on = torch.as_tensor(standard_on(body), dtype=torch.float32)
    return in_pose(replace(standard_body(), vertices=on, joints=body.joints.cpu()), pose)


def aligned(
    vertices: np.ndarray,
    faces: np.ndarray,
    body: Body,
    pose: torch.Tensor,
    *,
    loose: bool = False,
    where: str = "garment",
    place: Place | None = None,
) -> np.ndarray:
    """Vertices (N, 3) [m] of a garment around ``body`` (at rest in the standard stand) in ``pose``
    (24, 3) [rad], brought to the standard body in the T-pose.

    Each vertex goes with the body's vertex nearest to it, by the difference of both bodies there;
    one iteration of Laplacian smoothing follows. Of ``loose`` garments (dresses, skirts), which do
    not adhere to the legs, only the difference in shape is corrected: the pose stays. ``place``:
    how it was brought here, for what an error suggests. Raises InputError where the garment does
    not lie on the body, or was made for its rest.
    """
    check(vertices, faces, where)
    worn = wearer(body, pose)
    rest = lowered_stand(
        surface_of(wearer(body, standard_body().rest_pose)),
        "the garment itself to onefit.drape (on another body: to Garment.read, with made_for)",
    )
    check_place(vertices[np.unique(faces)], surface_of(worn), where, rest, place)
    target = in_pose(standard_body(), pose if loose else torch.zeros_like(pose))
    source = worn.vertices.double().numpy()
    nearest = cKDTree(source).query(vertices)[1]
    moved = vertices + (target.vertices.double().numpy() - source)[nearest]
    return 0.5 * (moved + mesh.neighbour_mean(faces, len(moved), boundary_apart=True) @ moved)
