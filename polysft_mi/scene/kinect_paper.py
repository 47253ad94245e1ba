"""Kinect-Paper (Varol et al. 2012): the camera and the flat template of a folder in that sequence's
form.
"""

import os
import re

import numpy as np

from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError

from .images import image_size, list_images

FILES = ("cam.intr", "cam.ext", "mesh.pts", "mesh.tri")
RESOLUTION = 33  # vertices a side of the template: so the given grid's own points are kept


def images(folder):
    """The images ``frame_*`` of the folder, sorted. Raises InputError where there are none, or
    several types of file.
    """
    found = [
        p
        for p in list_images(folder, "Kinect-Paper sequence")
        if os.path.basename(p).startswith("frame_")
    ]
    kinds = sorted({os.path.splitext(p)[1] for p in found})
    if len(kinds) != 1:
        raise InputError(
            f"{folder}: images frame_* of {len(kinds)}"
            f" types{' (' + ', '.join(kinds) + ')' if kinds else ''}; one type is needed"
        )
    return found


def camera(folder):
    """Intrinsics of a folder in the form of Kinect-Paper: K from ``cam.intr``, the size from the
    first image.
    """
    path = os.path.join(folder, "cam.intr")
    return Intrinsics.from_matrix(
        _numbers(path, (3, 3)), *image_size(images(folder)[0]), where=path
    )


def template(folder, resolution=RESOLUTION, pose_fit="auto", say=lambda line: None):
    """The flat template of a folder in the form of Kinect-Paper (Varol et al. 2012), in the camera
    frame of the first image.

    ``mesh.pts`` holds a grid of R x C points [mm], row after row, whose triangles ``mesh.tri``
    lists (from 0), and ``cam.ext`` the 3x4 matrix [R|T] [mm] that takes them to the camera; with
    ``pose_fit`` = ``auto`` the template is then moved, as a rigid body, until its outline lies on
    the edges in the first image that are near it, where these are clear
    (:func:`polysft_mi.poses.fitted`); ``none`` leaves it. The grid is interpolated (cubic where it
    has four points or more a side) at ``resolution`` points a side, evenly between the first and
    last row and column, so that at 33 the 9 x 9 grid's own points are kept. ``say`` takes a line
    about the pose.

    Returns ``(vertices (N, 3) [m, camera frame], faces (F, 3), uv (N, 2))`` with N = resolution^2,
    vertex ``j * resolution + i`` for row j and column i; uv is the projection into the first image,
    which is the texture: (0, 0) is its bottom left, v goes up. Raises InputError.
    """
    from scipy.interpolate import RectBivariateSpline

    from polysft_mi.poses import fitted

    from .images import read_rgb

    if resolution < 2:
        raise InputError(f"resolution = {resolution}; at least 2 vertices a side are needed")
    if pose_fit not in ("auto", "none"):
        raise InputError(f"pose_fit = {pose_fit!r}; auto or none is needed")
    path = os.path.join(folder, "mesh.pts")
    points = _numbers(path, (None, 3))
    triangles = _numbers(os.path.join(folder, "mesh.tri"), (None, 3))
    rows, columns = _grid_shape(len(points), triangles, folder)
    pose = _numbers(os.path.join(folder, "cam.ext"), (3, 4))
    if (
        np.abs(pose[:, :3] @ pose[:, :3].T - np.eye(3)).max() > 1e-2
        or np.linalg.det(pose[:, :3]) < 0
    ):
        raise InputError(
            f"{os.path.join(folder, 'cam.ext')}: its first three columns are not a rotation; [R|T]"
            " is needed"
        )

    view, points = camera(folder), 1e-3 * (points @ pose[:, :3].T + pose[:, 3])
    if points[:, 2].min() <= 0:
        raise InputError(
            f"{path}: the template lies behind the camera in the first image; check cam.ext"
        )
    fit = (
        fitted(points, triangles, view, read_rgb(images(folder)[0])) if pose_fit == "auto" else None
    )
    if fit is not None and fit.sure:
        points = fit(points)
        say(
            f"pose: from cam.ext, moved by {fit.moved:.1f} pixels to the edges of"
            f" {os.path.basename(images(folder)[0])}"
        )
    else:
        say("pose: from cam.ext")
    grid = points.reshape(rows, columns, 3)
    at = np.linspace(0, 1, resolution)
    spline = lambda z: RectBivariateSpline(
        np.linspace(0, 1, rows),
        np.linspace(0, 1, columns),
        z,
        kx=min(3, rows - 1),
        ky=min(3, columns - 1),
    )(at, at)
    vertices = np.stack([spline(grid[..., k]) for k in range(3)], axis=-1).reshape(-1, 3)
    uv = view.project(vertices) / (view.width, view.height)
    if not ((uv > 0) & (uv < 1)).all(axis=1).any():
        raise InputError(
            f"{path}: the template is out of view in the first image; check cam.ext and cam.intr"
        )
    uv[:, 1] = 1 - uv[:, 1]
    return vertices, _grid_faces(resolution, resolution), uv


def _grid_faces(rows, columns):
    """Two triangles a cell, with the diagonal and the orientation of ``mesh.tri``, (2 (rows-1)
    (columns-1), 3).
    """
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.stack([a, b, c, b, d, c], axis=1).reshape(-1, 3)


def _grid_shape(count, triangles, folder):
    """(rows, columns) of the grid of ``count`` points that the triangles span, two of them in every
    cell.
    """
    for columns in range(2, count // 2 + 1):
        rows = count // columns
        if rows * columns != count or len(triangles) != 2 * (rows - 1) * (columns - 1):
            continue
        j, i = np.divmod(triangles, columns)
        if (
            (triangles < count).all()
            and (np.ptp(j, axis=1) == 1).all()
            and (np.ptp(i, axis=1) == 1).all()
        ):
            _cells, uses = np.unique(j.min(axis=1) * columns + i.min(axis=1), return_counts=True)
            if (uses == 2).all():
                return rows, columns
    raise InputError(
        f"{os.path.join(folder, 'mesh.tri')}: its {len(triangles)} triangles do not make a grid of"
        f" the {count} points of mesh.pts, row after row"
    )


def _numbers(path, shape):
    """The matrix of numbers in a text file; None in ``shape`` is any length."""
    try:
        with open(path, encoding="utf-8") as file:
            rows = [
                [float(word) for word in re.split(r"[\s,;]+", line.strip())]
                for line in file
                if line.strip()
            ]
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file; a sequence in the form Kinect-Paper needs it"
        ) from None
    except ValueError as error:
        raise InputError(f"{path}: not a table of numbers ({error})") from None
    wanted = "x".join("N" if n is None else str(n) for n in shape)
    if not rows or any(len(r) != shape[1] for r in rows) or shape[0] not in (None, len(rows)):
        raise InputError(
            f"{path}: {len(rows)} rows of {', '.join(map(str, sorted({len(r) for r in rows})))}"
            f" numbers; {wanted} is needed"
        )
    table = np.array(rows)
    if not np.isfinite(table).all():
        raise InputError(f"{path}: holds numbers that are not finite")
    whole = path.endswith(".tri")
    if (whole and (table != np.round(table)).any()) or (whole and table.min() < 0):
        raise InputError(f"{path}: holds numbers that are not indices of points, counted from 0")
    return table.astype(np.int64) if whole else table
