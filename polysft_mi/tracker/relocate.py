"""Where a surface is by points of it that are known in an image: those that features of its texture
show, or that evidence names.
"""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.poses import FeatureRules, Features, detected, pairs

# of a lost sheet any hint counts: the objective judges what comes of it
_RULES = FeatureRules(count=2000, mutual=False)
_INLIERS = 12
_TOLERANCE = 12.0  # pixels that a surface may miss a point by: it is bent otherwise by now


def grey(image):
    """A linear image (H, W, 3) as 8-bit grey, gamma about that of sRGB."""
    return np.round(255 * np.clip(image.mean(-1), 0, 1) ** (1 / 2.2)).astype(np.uint8)


class TemplateFeatures:
    """The template's features, on the baked texture of a
    :class:`polysft_mi.images.data_term.DataTerm`.
    """

    def __init__(self, data):
        texture = data.texture.image
        found = detected(grey(texture), _RULES, data.texture.inside.astype(np.uint8))
        points = data.on_template(found.places - 0.5)
        known = np.isfinite(points).all(axis=1)
        self._points = points[known]
        self._features = Features(found.places[known], found.descriptors[known])

    def matches(self, image):
        """Points (M, 3) [m, world] of the template, and where a linear image (H, W, 3) shows them,
        (M, 2) [pixels]; some are wrong.
        """
        found = detected(grey(image), _RULES)
        ours, theirs = pairs(self._features, found, _RULES).T
        return self._points[ours], found.places[theirs]


def rigid_motion(camera, points, pixels):
    """The motion (Rotation, translation (3,) [m]), p -> R p + t in the world, that takes ``points``
    (M, 3) [m, world] of a surface to where a ``camera`` sees them, (M, 2) [pixels]; None where too
    few agree.
    """
    if len(points) < _INLIERS:
        return None
    to_camera = camera.axes
    points = camera.to_camera(points)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ (to_camera @ camera.basis).T
    rays = rays[:, :2] / rays[:, 2:]
    focal = 1 / np.linalg.norm(camera.basis[:, 0])
    how = dict(iterationsCount=300, flags=cv2.SOLVEPNP_EPNP)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, rays, np.eye(3), None, reprojectionError=_TOLERANCE / focal, **how
    )
    if not found or inliers is None or len(inliers) < _INLIERS:
        return None
    inliers = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[inliers], rays[inliers], np.eye(3), None, turn, shift)
    rotation = to_camera.T @ cv2.Rodrigues(turn)[0] @ to_camera
    translation = camera.origin + to_camera.T @ shift.ravel() - rotation @ camera.origin
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return Rotation.from_matrix(rotation), translation
