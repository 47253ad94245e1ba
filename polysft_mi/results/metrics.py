"""How far a reconstruction is from the truth: surfaces against meshes, depth points or point
clouds, images against images.

Lengths are metres in the camera frame (x right, y down, z forward) unless a name ends in ``_mm``.
``V`` and ``G`` are vertices (N, 3), ``F`` faces (F, 3). A figure of a sequence is the mean of the
figures of its frames.
"""

import numpy as np

PIXELS = 640 * 480  # image size behind the published "all pixels" figures of Kinect-Paper


# ---- meshes of one topology ----------------------------------------------------------------------


def rmse(V, G):
    """Root mean squared distance of corresponding vertices [m]."""
    return float(np.sqrt(np.mean(np.sum((V - G) ** 2, axis=1))))


def e3d(V, G):
    """||V - G||_F / ||G||_F, without alignment."""
    return float(np.linalg.norm(V - G) / np.linalg.norm(G))


def align_similarity(V, G, chosen=slice(None)):
    """V moved onto G (N, 3) by the similarity (scale, rotation without reflection, translation)
    that is best in least squares for the ``chosen`` vertices.

    Umeyama 1991, with the scale that minimises ||s V R + t - G||.
    """
    mean_v, mean_g = V[chosen].mean(axis=0), G[chosen].mean(axis=0)
    v, g = V[chosen] - mean_v, G[chosen] - mean_g
    left, singular, right = np.linalg.svd(v.T @ g)
    flip = np.ones(3)
    flip[2] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    rotation = (left * flip) @ right
    scale = np.dot(singular, flip) / np.sum(v**2)
    return scale * ((V - mean_v) @ rotation) + mean_g


def e3d_procrustes(V, G):
    """e3d after :func:`align_similarity` (the definition behind the table of phi-SfT)."""
    return e3d(align_similarity(V, G), G)


def normal_angle(V, G, F, chosen=slice(None)):
    """Mean angle between corresponding vertex normals [degrees], of the ``chosen`` vertices,
    without alignment.
    """
    from polyfit.mesh import vertex_normals

    cosine = np.sum(vertex_normals(V, F) * vertex_normals(G, F), axis=1)[chosen]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)).mean()))


# ---- depth points --------------------------------------------------------------------------------


def ray_depth(V, F, points):
    """Depth z (P,) [m] at which the rays from the camera through ``points`` (P, 3) first meet the
    mesh; NaN where they do not.

    Moeller and Trumbore 1997, with the ray's origin at 0, for the pairs of :func:`_close_pairs`.
    Triangles count from both sides.
    """
    p, e1, e2 = V[F[:, 0]], V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    across, along, normal = np.cross(e1, p), np.cross(p, e2), np.cross(e2, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = points / points[:, 2:3]
    directed = np.flatnonzero(
        np.isfinite(rays).all(axis=1)
    )  # a point that is missing, or lies at z = 0, has no ray
    triangle, ray = _close_pairs(V[F], rays[directed, :2])
    ray = directed[ray]

    def dot(a, b):
        return np.einsum("ij,ij->i", a, b)

    det = dot(rays[ray], normal[triangle])
    usable = np.abs(det) > 1e-18
    inverse = np.divide(1.0, det, out=np.zeros_like(det), where=usable)
    b1, b2 = dot(rays[ray], along[triangle]) * inverse, dot(rays[ray], across[triangle]) * inverse
    t = dot(p, normal)[triangle] * inverse
    # the slack keeps rays through the triangles' common edges
    hit = usable & (b1 >= -1e-6) & (b2 >= -1e-6) & (b1 + b2 <= 1 + 1e-6) & (t > 0)
    nearest = np.full(len(rays), np.inf)
    np.minimum.at(nearest, ray[hit], t[hit])
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _close_pairs(corners, xy):
    """(triangle, ray) of the pairs that may meet: the ray's xy (P, 2) at z = 1 lies in a circle
    around the triangle's projection.

    ``corners`` (F, 3, 3). A triangle that reaches behind the camera has no such circle and is
    paired with every ray.
    """
    from scipy.spatial import cKDTree

    before = (corners[:, :, 2] > 1e-9).all(axis=1)
    flat = corners[before, :, :2] / corners[before, :, 2:]
    centre = flat.mean(axis=1)
    radius = 1.01 * np.linalg.norm(flat - centre[:, None], axis=2).max(axis=1) + 1e-9
    near = cKDTree(xy).query_ball_point(centre, radius)
    every = np.flatnonzero(~before)
    triangle = np.concatenate(
        [np.repeat(np.flatnonzero(before), [len(n) for n in near]), np.repeat(every, len(xy))]
    )
    ray = np.concatenate(
        [np.asarray(n, dtype=np.int64) for n in near] + [np.tile(np.arange(len(xy)), len(every))]
    )
    return triangle.astype(np.int64), ray.astype(np.int64)


def depth_rmse(V, F, points):
    """(RMSE in depth [m] over the points (P, 3) whose ray meets the mesh, share of those points).
    The RMSE of none is inf.
    """
    error = ray_depth(V, F, points) - points[:, 2]
    error = error[np.isfinite(error)]
    share = len(error) / len(points)
    return (float(np.sqrt(np.mean(error**2))) if len(error) else float("inf")), share


def image_share(V, F, K, pixels=PIXELS):
    """Area of the mesh's triangles in the image, by its projection with K (3, 3), over the number
    of the image's pixels.
    """
    from polyfit.mesh import signed_areas

    xy = V @ K.T
    return float(np.abs(signed_areas(xy[:, :2] / xy[:, 2:], F)).sum() / pixels)


# ---- point clouds --------------------------------------------------------------------------------


def sample_surface(V, F, count, rng):
    """``count`` points (count, 3) spread evenly over the mesh's area."""
    edge1, edge2 = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    area = np.linalg.norm(np.cross(edge1, edge2), axis=1)
    pick = rng.choice(len(F), count, p=area / area.sum())
    outward, along = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    return V[F[pick, 0]] + outward * (edge1[pick] * (1 - along) + edge2[pick] * along)


def chamfer(A, B):
    """mean_a min_b |a - b|^2 + mean_b min_a |b - a|^2 [m^2] of the clouds A (P, 3) and B (Q, 3)."""
    from scipy.spatial import cKDTree

    return float(np.mean(cKDTree(B).query(A)[0] ** 2) + np.mean(cKDTree(A).query(B)[0] ** 2))


# ---- images --------------------------------------------------------------------------------------


def psnr(image, target, mask=None):
    """Peak signal-to-noise ratio [dB] of images (H, W, C) in [0, 1], over the pixels of ``mask``
    (H, W) where one is given.

    Infinite for equal images; NaN where the mask is empty.
    """
    squared = (np.asarray(image, np.float64) - target) ** 2
    if mask is not None:
        squared = squared[np.asarray(mask) > 0.5]
    if not squared.size:
        return float("nan")
    error = squared.mean()
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def ssim(image, target, mask=None):
    """Structural similarity of images (H, W, C) in [0, 1], as Wang et al. 2004 define it (Gaussian
    window of 1.5 pixels).

    With ``mask`` (H, W) the mean is taken over its pixels. NaN where the mask is empty or the image
    smaller than the window of 11 pixels.
    """
    import cv2

    if min(image.shape[:2]) < 11:
        return float("nan")
    inside = np.zeros(image.shape[:2], bool)
    inside[5:-5, 5:-5] = (
        True if mask is None else np.asarray(mask)[5:-5, 5:-5] > 0.5
    )  # the border, where the window leaves the image, never counts
    if not inside.any():
        return float("nan")
    rows, columns = (np.flatnonzero(inside.any(axis=k)) for k in (1, 0))
    near = slice(rows[0] - 5, rows[-1] + 6), slice(columns[0] - 5, columns[-1] + 6)
    x, y, inside = (
        np.asarray(image[near], np.float64),
        np.asarray(target[near], np.float64),
        inside[near],
    )

    def local(z):
        return cv2.GaussianBlur(z, (11, 11), 1.5)

    mx, my = local(x), local(y)
    cxx, cyy, cxy = local(x * x) - mx * mx, local(y * y) - my * my, local(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    field = (2 * mx * my + c1) * (2 * cxy + c2) / ((mx * mx + my * my + c1) * (cxx + cyy + c2))
    return float(field[inside].mean())
