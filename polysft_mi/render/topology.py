"""Which triangle lies across each edge, over all meshes of a scene. Import only after a Mitsuba
variant is set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from polyfit.device import on_device
from polysft_mi.errors import InputError


class Topology:
    """Triangles of all meshes of a scene in one numbering, with their neighbours. Detached;
    vertices that coincide are one.
    """

    def __init__(self, scene):
        self.shapes = scene.shapes()
        for shape in self.shapes:
            if not shape.is_mesh():
                raise InputError(
                    f"shape {shape.id()!r} is a {type(shape).__name__}; raster renders triangle"
                    " meshes only"
                )
        self._key = _key(self.shapes)
        faces, neighbours, face_offset, vertex_offset = [], [], [0], [0]
        for shape in self.shapes:
            f = np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)
            v = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
            _, welded = np.unique(v, axis=0, return_inverse=True)
            n = _neighbours(welded.reshape(-1)[f])
            faces.append(f + vertex_offset[-1])
            neighbours.append(np.where(n >= 0, n + face_offset[-1], -1))
            face_offset.append(face_offset[-1] + len(f))
            vertex_offset.append(vertex_offset[-1] + len(v))
        self.face_count, self.vertex_count = face_offset[-1], vertex_offset[-1]
        self.faces = on_device(np.concatenate(faces), mi.UInt32)
        self.neighbours = on_device(np.concatenate(neighbours), mi.Int32)
        # from a shape's place in the registry to its first triangle
        self.face_offset = dr.zeros(
            mi.UInt32,
            1 + max(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0] for s in self.shapes),
        )
        for shape, offset in zip(self.shapes, face_offset):
            dr.scatter(
                self.face_offset,
                mi.UInt32(offset),
                dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)),
            )
        dr.eval(self.faces, self.neighbours, self.face_offset)

    def fits(self, scene):
        """Whether the scene still has these shapes, with as many faces and vertices."""
        return self._key == _key(scene.shapes())

    def positions(self):
        """Positions of all vertices, a flat Float64 of 3V, attached.

        In double precision for the sake of their gradients: threads add these up in any order, and
        only in float32 does the order show.
        """
        return mi.Float64(_joined([s.vertex_positions_buffer() for s in self.shapes]))

    def texcoords(self):
        """Texture coordinates of all vertices, a flat Float of 2V; zeros for meshes that have
        none.
        """

        def own(s):
            if s.has_vertex_texcoords():
                return s.vertex_texcoords_buffer()
            return dr.zeros(mi.Float, 2 * s.vertex_count())

        return _joined([own(s) for s in self.shapes])


def _key(shapes):
    return tuple(
        (id(s), s.face_count(), s.vertex_count()) if s.is_mesh() else id(s) for s in shapes
    )


def _joined(arrays):
    return arrays[0] if len(arrays) == 1 else dr.concat(arrays)


def _neighbours(faces):
    """Across edge k of each triangle, from corner k to corner k+1: the other triangle, or -1. faces
    (F, 3) -> (F, 3).
    """
    edge = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    _, edge_id, count = np.unique(edge, axis=0, return_inverse=True, return_counts=True)
    edge_id = edge_id.reshape(-1)
    half = np.argsort(edge_id, kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    out = np.full(len(edge), -1, dtype=np.int64)
    two = first[count == 2]
    out[half[two]], out[half[two + 1]] = half[two + 1] // 3, half[two] // 3
    return out.reshape(-1, 3)
