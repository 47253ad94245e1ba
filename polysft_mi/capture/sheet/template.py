"""The template before it is placed: a flat grid of the given size, or an OBJ of one's own."""

from dataclasses import dataclass

import numpy as np

from polyfit.mesh import TexCoords
from polysft_mi.errors import InputError
from polysft_mi.surface import meshio

from .size import LARGEST, SMALLEST

_RESOLUTION = 33  # vertices along the longer side, where nothing is said


@dataclass(frozen=True)
class Sheet:
    """A template in a frame of its own (x right, y down, z away from who looks at its print):
    ``vertices`` (N, 3) [m], ``faces`` (F, 3), ``uv`` (N, 2) of its photo, v up; ``name``: what it
    is, in words. ``source`` (N,): of an OBJ whose texture has seams, where each vertex is in the
    file, for here vertices are split along seams. ``one_sided``: whether it is a sheet, which one
    jet holds: else it hides a part of itself.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    name: str
    source: np.ndarray | None = None
    one_sided: bool = True

    @property
    def flat(self):
        """Whether one plane holds it, up to a thousandth of its extent."""
        s = np.linalg.svd(self.vertices - self.vertices.mean(0), compute_uv=False)
        return s[2] <= 1e-3 * s[0]

    def mesh(self, placed):
        """The template with its vertices ``placed`` (N, 3) as its file has it: vertices, faces, and
        :class:`polyfit.mesh.TexCoords`.
        """
        source = np.arange(len(placed)) if self.source is None else self.source
        vertices = np.empty((source.max() + 1, 3))
        vertices[source] = placed
        return vertices, source[self.faces], TexCoords(self.uv, self.faces)

    def in_view(self, placed, camera):
        """The faces (V, 3) that the camera sees of the vertices ``placed`` (N, 3) [m, camera
        frame]; all of a sheet, which is looked at from its front.
        """
        if self.one_sided:
            return self.faces
        from polyfit.pictures import Triangles

        (depth,) = Triangles(placed, self.faces).seen(camera)
        middle = placed[self.faces].mean(1)
        x, y = np.floor(camera.project(middle)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        near = depth[np.where(inside, y, 0), np.where(inside, x, 0)]
        room = np.ptp(placed[self.faces], axis=1).max(1)  # a face that is seen at an angle
        return self.faces[inside & (middle[:, 2] <= near + 0.5 * room)]

    def at(self, uv):
        """Points (K, 3) [m] of the surface whose photo has the coordinates uv (K, 2); NaN where the
        photo does not lie on it.
        """
        uv = np.asarray(uv, dtype=float)
        a, b, c = (self.uv[self.faces[:, k]] for k in range(3))
        to_edges = np.linalg.pinv(np.stack([b - a, c - a], axis=2))  # of no area: zeros
        points = np.full((len(uv), 3), np.nan)
        for start in range(0, len(uv), 256):
            part = slice(start, start + 256)
            t = np.einsum("fij,kfj->kfi", to_edges, uv[part, None] - a)
            inner = np.concatenate([1 - t.sum(2, keepdims=True), t], axis=2)
            least = inner.min(axis=2)
            if ((least > 1e-6).sum(axis=1) > 1).any():
                raise InputError(
                    f"{self.name}: its texture coordinates overlap; each place of the photo must"
                    " belong to one place of the template"
                )
            face = least.argmax(axis=1)
            rows = np.arange(len(face))
            found = np.einsum("kc,kci->ki", inner[rows, face], self.vertices[self.faces[face]])
            points[part] = np.where(least[rows, face, None] >= -1e-9, found, np.nan)
        return points

    def corners(self):
        """Its points (4, 3) [m] that are nearest to the photo's corners: top left, top right,
        bottom right, bottom left.
        """
        low, high = self.uv.min(0), self.uv.max(0)
        wanted = np.array([[low[0], high[1]], high, [high[0], low[1]], low])
        return self.vertices[
            np.argmin(np.linalg.norm(self.uv[None] - wanted[:, None], axis=2), axis=1)
        ]


def grid(width, height, resolution=None):
    """The :class:`Sheet` of a flat rectangle of ``width`` x ``height`` [m], ``resolution`` vertices
    along its longer side (33), its cells about square."""
    resolution = _RESOLUTION if resolution is None else resolution
    if not 2 <= resolution <= 400:
        raise InputError(
            f"--resolution {resolution}: 2 to 400 vertices along the longer side can be used"
        )
    longer = max(width, height)
    columns, rows = (
        max(2, round((resolution - 1) * side / longer) + 1) for side in (width, height)
    )
    y, x = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    vertices = np.stack([(x - 0.5) * width, (y - 0.5) * height, np.zeros_like(x)], axis=-1).reshape(
        -1, 3
    )
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    faces = np.stack([a, b, c, b, d, c], axis=1).reshape(-1, 3)
    return Sheet(
        vertices,
        faces,
        np.stack([x, 1 - y], axis=-1).reshape(-1, 2),
        f"a sheet of {1e3 * width:.4g} x {1e3 * height:.4g} mm, {columns}x{rows} vertices",
    )


def from_obj(path):
    """The :class:`Sheet` of an OBJ in metres with texture coordinates, its frame any. Raises
    InputError.
    """
    from polysft_mi.surface import Template

    vertices, faces, texcoords = meshio.read_textured_template(path)
    meshio.check_template(vertices, faces, texcoords, path)
    texcoords = _on_photo(texcoords, path)
    vertices = vertices - vertices[np.unique(faces)].mean(0)  # before anything is single precision
    extent = np.ptp(vertices, axis=0).max()
    if not SMALLEST <= extent <= LARGEST:
        hint = "in millimetres? write it in metres" if extent > LARGEST else "write it in metres"
        raise InputError(
            f"{path}: a template of {extent:.4g} m; {1e3 * SMALLEST:g} mm to {LARGEST:g} m can be"
            f" used ({hint})"
        )
    patches = len(Template.fit(vertices, faces, texcoords, 4, exact=False, where=path))
    source, uv, split = texcoords.split(faces)
    return Sheet(
        vertices[source],
        split,
        uv,
        f"{path}, {len(vertices)} vertices" + (f" in {patches} patches" if patches > 1 else ""),
        source,
        patches == 1,
    )


def _on_photo(texcoords, path):
    """The texture coordinates on the one photo: those of one tile of several (UDIM) are moved to
    it. Raises InputError where they reach into more tiles than one.
    """
    used = texcoords.coordinates[np.unique(texcoords.faces)]
    tile = np.floor((used.min(0) + used.max(0)) / 2)
    moved = TexCoords(texcoords.coordinates - tile, texcoords.faces)
    if meshio.uv_note(moved):
        raise InputError(f"{meshio.uv_note(texcoords, path)}; scale them to the photo")
    return moved
