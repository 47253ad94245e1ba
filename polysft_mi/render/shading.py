"""The surface where the rays hit, recomputed with gradients, and its own colour there. Import only
after a Mitsuba variant is set.
"""

import drjit as dr
import mitsuba as mi

from .view import gather_point


def interaction(topology, positions, shape, triangle, ray, length, hit):
    """Surface interaction of rays with the planes of their triangles (attached), and depth
    along the axis.
    """
    t = mi.UInt32(dr.select(hit, triangle, 0))
    index = [dr.gather(mi.UInt32, topology.faces, 3 * t + k, hit) for k in range(3)]
    p0, p1, p2 = (gather_point(positions, i, hit) for i in index)
    e1, e2 = p1 - p0, p2 - p0
    # Moeller-Trumbore, without its tests: the ray is known to hit
    pv = dr.cross(ray.d, e2)
    inverse = dr.select(hit, dr.rcp(dr.dot(e1, pv)), 0)
    tv = ray.o - p0
    qv = dr.cross(tv, e1)
    b1, b2 = dr.dot(tv, pv) * inverse, dr.dot(ray.d, qv) * inverse
    distance = dr.dot(e2, qv) * inverse
    texcoords = topology.texcoords()
    c0, c1, c2 = (dr.gather(mi.Point2f, texcoords, i, hit) for i in index)

    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(triangle))
    si.t = dr.select(hit, distance, dr.inf)
    si.p = ray.o + ray.d * distance
    si.uv = c0 + (c1 - c0) * b1 + (c2 - c0) * b2
    n = dr.normalize(dr.cross(e1, e2))
    si.n = dr.mulsign(n, -dr.dot(n, ray.d))  # both sides face the camera
    si.sh_frame.n = si.n
    si.wi = mi.Vector3f(0, 0, 1)  # unlit: as seen from the front
    si.shape = shape
    return si, distance / length


def unlit(si, hit):
    """The texture's own colour, from either side: 3 Floats, 0 where there is no surface."""
    return [dr.select(hit, c, 0) for c in mi.Color3f(si.bsdf().eval_diffuse_reflectance(si, hit))]
