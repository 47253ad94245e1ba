"""Patches of garment meshes, to train on and to measure on: cut by ACVD, sampled evenly by area,
with the mesh's normals; as they are, or posed.
"""

from dataclasses import dataclass

import numpy as np
import torch

from polyfit import mesh
from polyfit.jets import CanonicalFrame
from polyfit.mesh import read_mesh
from polyfit.patches import Patches

from . import deformations


@dataclass(frozen=True)
class GarmentPatches:
    """``points`` (M, P, 3) [m] and unit ``normals`` (M, P, 3), float32, of M patches."""

    points: torch.Tensor
    normals: torch.Tensor

    def __len__(self):
        return len(self.points)

    @classmethod
    def join(cls, parts):
        return cls(torch.cat([p.points for p in parts]), torch.cat([p.normals for p in parts]))

    @classmethod
    def cut(cls, vertices, faces, count, points, generator, where="mesh", **how):
        """The mesh (N, 3) [m], (F, 3) cut into ``count`` patches (None: the paper's number), each
        sampled at ``points`` places; ``generator`` is NumPy's, ``how`` as in
        :meth:`polyfit.patches.Patches.cut`.
        """
        return cls.sample(
            Patches.cut(vertices, faces, count, where=where, **how), points, generator
        )

    @classmethod
    def sample(cls, patches, points, generator, vertices=None):
        """``points`` places, uniform in area, of every patch of a :class:`polyfit.patches.Patches`,
        with its vertices where they are or at ``vertices`` (M, 3) [m].

        Normals are interpolated between those of the vertices, which are means of the faces around
        them. A face that touches several patches belongs to that of its first corner.
        """
        V, F = (
            patches.vertices if vertices is None else np.asarray(vertices, dtype=np.float64),
            patches.faces,
        )
        face_vectors = mesh.face_vectors(V, F)
        N = np.stack(
            [np.bincount(F.ravel(), np.repeat(x, 3), minlength=len(V)) for x in face_vectors.T],
            axis=1,
        )
        area, owner = np.linalg.norm(face_vectors, axis=1), patches.corner_patch[:, 0]
        order = np.argsort(owner, kind="stable")
        ends = np.searchsorted(owner[order], np.arange(len(patches) + 1))
        chosen = []
        for k in range(len(patches)):
            faces = order[ends[k] : ends[k + 1]]
            # a patch of a few vertices may be no face's first corner
            if len(faces) and area[faces].sum() > 0:
                chosen.append(generator.choice(faces, points, p=area[faces] / area[faces].sum()))
        chosen = np.array(chosen)
        b = generator.dirichlet((1, 1, 1), chosen.shape)
        x, n = (np.einsum("mpi,mpid->mpd", b, y[F[chosen]]) for y in (V, N))
        n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300)
        return cls(torch.as_tensor(x, dtype=torch.float32), torch.as_tensor(n, dtype=torch.float32))

    def drawn(self, count, generator):
        """``count`` of the patches, drawn at random, as they are, with their points in a random
        order.
        """
        index = torch.randint(len(self), (count,), generator=generator)
        order = torch.rand(count, self.points.shape[1], generator=generator).argsort(1)
        mixed = lambda x: x[index].gather(1, order[..., None].expand(-1, -1, 3))
        return GarmentPatches(mixed(self.points), mixed(self.normals))

    def deformed(self, count, generator, **strength):
        """``count`` of the patches, drawn at random and each taken through a random smooth map in
        its own canonical frame; ``strength`` as in :func:`deformations.random`.
        """
        index = torch.randint(len(self), (count,), generator=generator)
        x, n = self.points[index], self.normals[index]
        frame = CanonicalFrame.from_points(x)
        return GarmentPatches(
            *deformations.random(count, generator, **strength).map_with_normals(
                frame.to_chart(x), n @ frame.R
            )
        )


def cut_meshes(paths, counts, points, seed, **how):
    """:class:`GarmentPatches` of the mesh files ``paths``, each cut at every one of ``counts``
    (None: the paper's number); ``how`` as in :meth:`polyfit.patches.Patches.cut`. Raises InputError
    for a file that is no mesh.
    """
    generator = np.random.default_rng(seed)
    parts = []
    for path in paths:
        vertices, faces = read_mesh(path)[:2]
        vertices = mesh.centred(vertices)[0]
        parts += [
            GarmentPatches.cut(vertices, faces, count, points, generator, str(path), **how)
            for count in counts
        ]
    return GarmentPatches.join(parts)
