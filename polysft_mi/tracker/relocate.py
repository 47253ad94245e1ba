"""Finding a lost sheet again: features of the template's texture in the image, and the rigid pose
that they give.
"""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.poses import FeatureRules, Features, detected, pairs

# of a lost sheet any hint counts: the objective judges what comes of it
_RULES = FeatureRules(count=2000, mutual=False)
_INLIERS = 12
_TOLERANCE = 12.0  # pixels that the flat template may miss a match by: the sheet is bent


def grey(image):
    """A linear image (H, W, 3) as 8-bit grey, gamma about that of sRGB."""
    return np.round(255 * np.clip(image.mean(-1), 0, 1) ** (1 / 2.2)).astype(np.uint8)


class Relocator:
    """The template's features, on the baked texture of a
    :class:`polysft_mi.images.data_term.DataTerm`.
    """

    def __init__(self, data):
        self.camera = data.camera
        texture = data.texture.image
        found = detected(grey(texture), _RULES, data.texture.inside.astype(np.uint8))
        points = data.on_template(found.places - 0.5)
        known = np.isfinite(points).all(axis=1)
        self._points = points[known]
        self._features = Features(found.places[known], found.descriptors[known])

    def pose(self, image):
        """The motion (Rotation, translation (3,) [m]), p -> R p + t in the world, from the template
        to a linear image (H, W, 3); None where too few features agree."""
        found = detected(grey(image), _RULES)
        ours, theirs = pairs(self._features, found, _RULES).T
        if len(ours) < _INLIERS:
            return None
        pixels = found.places[theirs]
        camera, to_camera = self.camera, self.camera.axes
        points = camera.to_camera(self._points[ours])
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
        turn, shift = cv2.solvePnPRefineLM(
            points[inliers], rays[inliers], np.eye(3), None, turn, shift
        )
        rotation = to_camera.T @ cv2.Rodrigues(turn)[0] @ to_camera
        translation = camera.origin + to_camera.T @ shift.ravel() - rotation @ camera.origin
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            return None
        return Rotation.from_matrix(rotation), translation
