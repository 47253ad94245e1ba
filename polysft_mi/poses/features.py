"""What two images share: SIFT features, and which of one image are which of the other."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np


@dataclass(frozen=True)
class FeatureRules:
    """What counts as a feature, and as a pair.

    - ``count``: features of an image at most; ``contrast``: the least that one has.
    - ``ratio`` of the distances to the best and the second match, above which a match is ambiguous.
    - ``mutual``: whether each of a pair must be the other's best. That spares chance matches where
      a print repeats itself, and costs some where a sheet is bent or blurred.
    """

    count: int = 5000
    contrast: float = 0.02
    ratio: float = 0.8
    mutual: bool = True


class Features(NamedTuple):
    """``places`` (K, 2) [pixels], ``descriptors`` (K, 128)."""

    places: np.ndarray
    descriptors: np.ndarray


def detected(grey, rules, inside=None):
    """The :class:`Features` of an image (H, W) uint8, with ``inside`` (H, W) uint8 those where it
    is not 0.
    """
    detector = cv2.SIFT_create(nfeatures=rules.count, contrastThreshold=rules.contrast)
    keys, descriptors = detector.detectAndCompute(grey, inside)
    places = np.array([key.pt for key in keys]).reshape(-1, 2) + 0.5
    return Features(places, np.empty((0, 128), np.float32) if descriptors is None else descriptors)


def pairs(a, b, rules):
    """The numbers (M, 2) of the :class:`Features` a and b that show the same."""
    if min(len(a.places), len(b.places)) < 2:
        return np.empty((0, 2), int)
    matcher = cv2.BFMatcher()
    there = matcher.knnMatch(a.descriptors, b.descriptors, k=2)
    good = [m for m, second in there if m.distance < rules.ratio * second.distance]
    if rules.mutual:
        back = matcher.match(b.descriptors, a.descriptors)
        good = [m for m in good if back[m.trainIdx].trainIdx == m.queryIdx]
    return np.array([(m.queryIdx, m.trainIdx) for m in good], int).reshape(-1, 2)
