"""Finding a lost sheet again: features of the template's texture in the image, and the rigid pose
that they give. NumPy and OpenCV only.
"""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

# of the distances to the best and the second match, above which a match counts as ambiguous
_RATIO = 0.8
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
        self._detector = cv2.SIFT_create(nfeatures=2000, contrastThreshold=0.02)
        texture = data.texture.image
        inside = data.texture.inside.astype(np.uint8)
        keys, self._descriptors = self._detector.detectAndCompute(grey(texture), inside)
        self._points = (
            data.on_template(np.array([k.pt for k in keys]).reshape(-1, 2))
            if keys
            else np.empty((0, 3))
        )
        known = np.isfinite(self._points).all(axis=1)
        self._points = self._points[known]
        self._descriptors = self._descriptors[known] if self._descriptors is not None else None

    def pose(self, image):
        """The motion (Rotation, translation (3,) [m]), p -> R p + t in the world, from the template
        to a linear image (H, W, 3); None where too few features agree."""
        keys, descriptors = self._detector.detectAndCompute(grey(image), None)
        if (
            descriptors is None
            or self._descriptors is None
            or len(keys) < _INLIERS
            or len(self._points) < _INLIERS
        ):
            return None
        matches = cv2.BFMatcher().knnMatch(self._descriptors, descriptors, k=2)
        good = [m[0] for m in matches if len(m) == 2 and m[0].distance < _RATIO * m[1].distance]
        if len(good) < _INLIERS:
            return None
        pixels = np.array([keys[m.trainIdx].pt for m in good]) + 0.5
        camera, to_camera = self.camera, self.camera.axes
        points = camera.to_camera(self._points[[m.queryIdx for m in good]])
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ (to_camera @ camera.basis).T
        rays = rays[:, :2] / rays[:, 2:]
        focal = 1 / np.linalg.norm(camera.basis[:, 0])
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            rays,
            np.eye(3),
            None,
            reprojectionError=_TOLERANCE / focal,
            iterationsCount=300,
            flags=cv2.SOLVEPNP_EPNP,
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
