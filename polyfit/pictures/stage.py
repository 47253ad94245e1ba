"""Pictures of meshes, by Mitsuba's rays: what a camera sees of one (:meth:`Triangles.seen`), a
matte view of its relief from any side (:meth:`Triangles.shaded`), and moving meshes on a floor in
soft light (:func:`render`, :class:`Stage`), which is how drapes of OneFit become videos.

The soft light is found at the corners of the faces that the camera sees, by rays in directions that
are the same for all, and runs smoothly between. So a picture has no grain, and costs a fraction of
a traced path's.

What is made here needs a Mitsuba variant.
"""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from polyfit import mesh
from polyfit.colours import srgb
from polyfit.device import on_device

MARGIN = 1.12  # of the picture around what moves
_FOV = 28.0  # degrees, of the picture's height
FLOOR = np.array([0.36, 0.37, 0.39])  # linear RGB
SKY = np.array([0.50, 0.53, 0.58])  # its radiance, the same from everywhere above
_BOUNCE = 0.3  # radiance of floor, skin and cloth as seen from a vertex, a share of the sky's
KEY = np.array([1.25, 1.2, 1.12])  # irradiance of the key light, across its direction
_TOWARDS_KEY = np.array([0.22, -0.71, 0.75])  # for a camera that looks along y
_KEY_RADIUS = 8.0  # degrees, as the key light is seen
_SKY_RAYS, _KEY_RAYS = 128, 32  # from each vertex
GRID, _REACH = 96, 1.5  # cells of the floor's light along a side, and half of its side [m]
FINE = 20_000  # faces
_COVER = 0.025  # [m]; what lies so near before a vertex covers it, and half so near aside
_LIFT = 2e-3  # [m] by which rays start above a surface


def render(parts, *, size=(640, 480), spp=16, azimuth=25.0, elevation=8.0, follow=False, near=None):
    """Images (H, W, 3) uint8 sRGB, one a frame, of moving meshes on a floor.

    ``parts``: of each mesh its vertices (T, N, 3) [m, z up], its faces (F, 3) and its colour,
    linear RGB; a mesh of fewer than :data:`FINE` faces is drawn as a smooth surface.
    ``size``: (height, width) [pixels]; ``spp``: samples a pixel, on a square grid; ``azimuth``
    [degrees] to the side of the -y axis that the camera stands on, ``elevation`` above the floor.
    The camera keeps all in the picture; with ``follow`` it goes along with what moves. ``near``:
    the number of one of the parts; the camera keeps that one in the picture.
    """
    parts = [_smooth(*part) for part in parts]
    everything = np.concatenate([v for v, _, _ in parts], axis=1)
    counts = [v.shape[1] for v, _, _ in parts]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    faces = np.concatenate([f + k for (_, f, _), k in zip(parts, first)])
    colours = np.repeat([c for _, _, c in parts], counts, axis=0)
    part = np.repeat(np.arange(len(parts)), counts)
    floor = float(everything[..., 2].min())
    kept = everything if near is None else parts[near][0]
    low, high = kept.min(axis=1), kept.max(axis=1)  # (T, 3)
    middle = (low.min(axis=0) + high.max(axis=0)) / 2
    half = ((high - low).max(axis=0) if follow else high.max(axis=0) - low.min(axis=0)) / 2 * MARGIN
    height, width = size
    across = max(half[2], np.hypot(half[0], half[1]) * height / width)
    a, e = np.deg2rad((azimuth, elevation))
    away = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    away *= across / np.tan(np.deg2rad(_FOV / 2)) + half[1]
    stage = Stage(everything[0], faces, colours, floor, a, part)
    for t, vertices in enumerate(everything):
        target = (low[t] + high[t]) / 2 if follow else middle
        stage.move(vertices)
        yield stage.picture(target + away, target, size, spp)


class Triangles:
    """A mesh that rays can meet: ``vertices`` (N, 3) [m], ``faces`` (F, 3)."""

    def __init__(self, vertices, faces):
        shape = mi.Mesh("mesh", len(vertices), len(faces))
        params = mi.traverse(shape)
        params["faces"] = on_device(faces, mi.UInt32)
        params["vertex_positions"] = on_device(vertices, mi.Float)
        params.update()
        self.scene = mi.load_dict({"type": "scene", "mesh": shape})
        self.params = mi.traverse(self.scene)
        self.key = next(k for k in self.params.keys() if k.endswith("vertex_positions"))
        self.vertices, self.faces = vertices, faces
        self.corners = mi.Vector3u(faces.T.astype(np.uint32))

    def move(self, vertices):
        """The vertices are at (N, 3) [m] from now on."""
        self.params[self.key] = on_device(vertices, mi.Float)
        self.params.update()
        self.vertices = vertices

    def seen(self, camera, values=()):
        """What a camera sees: depth (H, W) [m], NaN beyond the mesh, and an image (H, W) of each of
        ``values`` (N,), given at the vertices.

        The vertices are in the camera's frame; ``camera`` says ``fx``, ``fy``, ``cx``, ``cy``,
        ``width`` and ``height`` [pixels]. Interpolation is perspective, at the pixels' centres, in
        single precision.
        """
        x, y = _samples(camera.width, camera.height)
        x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
        hit = self._hit(mi.Point3f(0), mi.Vector3f(x, y, 1))
        images = [hit.t, *(self._mixed(hit, on_device(v, mi.Float)) for v in values)]
        images = [np.array(dr.select(hit.is_valid(), x, dr.nan)) for x in images]
        return tuple(x.reshape(camera.height, camera.width) for x in images)

    def shaded(self, view=None, uv=None, size=(480, 480), look=None):
        """A matte picture (height, width, 3) uint8 sRGB; ``size`` = (width, height), ``view``:
        :class:`SideView`, by default one around the mesh.

        Lambert shading with smooth normals under a key light from the left and a weak fill, warm on
        the side from which the triangles' normals point to the viewer, cool on the other. With
        ``uv`` (F, 3, 2), of the faces' corners, a thin grid of ten by ten cells is drawn. ``look``:
        :class:`ShadingLook`.
        """
        look, view = look or ShadingLook(), view or SideView.around(self.vertices)
        (width, height), side = size, look.supersample
        x, y = _samples(width, height, side)
        scale = 2 * view.radius / min(width, height)
        right, down, ahead = (mi.Vector3f(*map(float, row)) for row in view.rotation)
        near = ((self.vertices - view.centre) @ view.rotation[2]).min(initial=0.0) - view.radius
        start = mi.Point3f(*map(float, view.centre + near * view.rotation[2]))
        start += scale * (x - width / 2) * right + scale * (y - height / 2) * down
        hit = self._hit(start, ahead)
        normals = mesh.vertex_normals(self.vertices, self.faces) @ view.rotation.T
        across = mesh.face_vectors(self.vertices, self.faces) @ view.rotation[2]
        away = dr.gather(mi.Bool, mi.Bool(across > 0), hit.prim_index, hit.is_valid())
        front, back = (
            self._mixed(hit, on_device(_light(n, look), mi.Float)) for n in (normals, -normals)
        )
        light = dr.clip(dr.select(away, back, front), 0, 2)
        for values in () if uv is None else np.moveaxis(np.asarray(uv, np.float64), 2, 0):
            cells = 10 * (values - values.min()) / max(np.ptp(values), 1e-12)
            at = self._mixed(hit, on_device(cells, mi.Float), of_corners=True)
            light *= 1 - 0.17 * dr.clip(2 - dr.abs(at - dr.round(at)) / 0.03, 0, 1)
        colour = light * dr.select(away, mi.Color3f(*look.back), mi.Color3f(*look.front))
        colour = dr.select(hit.is_valid(), colour, mi.Color3f(look.background))
        return _developed(colour, width, height, side)

    def _hit(self, start, direction):
        return self.scene.ray_intersect_preliminary(mi.Ray3f(start, direction), coherent=True)

    def _mixed(self, hit, values, of_corners=False):
        """A Dr.Jit array of ``values`` at the vertices, or at the corners of the faces (3 F), where
        rays meet the mesh.
        """
        on, b = hit.is_valid(), hit.prim_uv
        corner = 3 * hit.prim_index + mi.Vector3u(0, 1, 2)
        if not of_corners:
            corner = dr.gather(mi.Vector3u, self.corners, hit.prim_index, on)
        share = 1 - b.x - b.y, b.x, b.y
        return sum(dr.gather(type(values), values, corner[k], on) * share[k] for k in range(3))


@dataclass(frozen=True)
class ShadingLook:
    """How a surface is shaded. Colours are linear RGB.

    ``background``: grey; ``front``, ``back``: albedo of the two sides; ``key``, ``fill``: towards
    the two lights, in the view's frame; ``supersample``: samples a pixel and axis.
    """

    background: float = 0.90
    front: tuple = (0.80, 0.56, 0.33)
    back: tuple = (0.30, 0.47, 0.66)
    key: tuple = (-0.80, -0.50, -0.45)
    fill: tuple = (0.60, -0.20, -0.80)
    supersample: int = 2


@dataclass(frozen=True)
class SideView:
    """An orthographic view: rows of ``rotation`` (3, 3) are the picture's right, down and forward
    in the camera frame.

    ``centre`` (3,) [m] lies in the middle of the picture and ``radius`` [m] reaches from it to the
    nearer pair of borders.
    """

    rotation: np.ndarray
    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, points, azimuth=40.0, elevation=25.0):
        """The view of points (..., 3) [m] after the camera went round them by ``azimuth`` to its
        right and ``elevation`` up [degrees].

        Give the points of all frames to see all frames from one place.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        a, e = np.radians([azimuth, elevation])
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        tilt = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
        rotation = tilt @ turn
        seen = points @ rotation.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        return cls(rotation, (low + high) / 2 @ rotation, 0.55 * float(np.max((high - low)[:2])))

    def wider(self, factor):
        """The same view with ``factor`` times as much in it."""
        return replace(self, radius=factor * self.radius)

    def holds(self, points):
        """Whether points (..., 3) [m] all lie in the picture, whatever its form."""
        seen = (np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.centre) @ self.rotation.T
        return bool((np.abs(seen[:, :2]) <= self.radius).all())


def _light(normals, look):
    """Light on unit normals (N, 3) of the view's frame: (N,)."""
    key, fill = (np.asarray(d) / np.linalg.norm(d) for d in (look.key, look.fill))
    return 0.10 + 0.95 * np.maximum(normals @ key, 0) + 0.20 * np.maximum(normals @ fill, 0)


def _samples(width, height, side=1):
    """The places x, y [pixels] of ``side`` by ``side`` samples in each pixel, row after row; aside
    by a thousandth, for a ray exactly along an edge can miss both of its faces.
    """
    index = dr.arange(mi.UInt32, height * side * width * side)
    x, y = index % (width * side), index // (width * side)
    return (mi.Float(x) + 0.501) / side, (mi.Float(y) + 0.5007) / side


def _developed(colour, width, height, side):
    """The picture (H, W, 3) uint8 sRGB of the linear colours of :func:`_samples`."""
    samples = np.array(dr.clip(colour, 0, 1)).T.reshape(height, side, width, side, 3)
    return np.round(255 * srgb(samples.mean(axis=(1, 3)))).astype(np.uint8)


class Stage(Triangles):
    """One mesh, ``vertices`` (N, 3) [m], ``faces`` (F, 3), with a colour (N, 3) at each vertex, on
    a floor at the height ``floor`` [m]; the key light is turned with the camera, by ``azimuth``
    [rad]. ``part`` (N,): which thing a vertex belongs to; by default all are one.
    """

    def __init__(self, vertices, faces, colours, floor, azimuth=0.0, part=None):
        super().__init__(vertices, faces)
        self.floor = floor
        self.part = np.zeros(len(vertices), np.uint32) if part is None else part.astype(np.uint32)
        self.part_of_face = on_device(self.part[faces[:, 0]], mi.UInt32)
        self.colour = mi.Color3f(colours.T.astype(np.float32))
        self.sky = _sphere(_SKY_RAYS)
        x, y, z = _TOWARDS_KEY / np.linalg.norm(_TOWARDS_KEY)
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        towards = np.array([cos * x - sin * y, sin * x + cos * y, z])
        self.sun = _cap(towards, _KEY_RADIUS, _KEY_RAYS)

    def move(self, vertices):
        super().move(vertices)
        self.normals = mesh.vertex_normals(np.float64(vertices), self.faces)
        self.normal = on_device(self.normals, mi.Vector3f)

    def light(self, target, asked=None):
        """Light falls on the vertices, on those ``asked`` (N,) alone if given, and on the floor
        around ``target``.
        """
        asked = np.ones(len(self.vertices), bool) if asked is None else asked
        light = self._uncovered(asked)
        self.front, self.back = (on_device(x, mi.Color3f) for x in (light[:, :3], light[:, 3:6]))
        self.shadow = on_device(light[:, 6], mi.Float)
        self.centre = np.asarray(target, np.float64)[:2]
        x = np.linspace(-_REACH, _REACH, GRID)
        y, x = np.meshgrid(self.centre[1] + x, self.centre[0] + x, indexing="ij")
        ground = np.stack([x, y, np.full_like(x, self.floor - _LIFT)], -1).reshape(-1, 3)
        up = np.tile([0.0, 0.0, 1.0], (len(ground), 1))
        light = self._irradiance(ground, up)
        lit = FLOOR * (light[:, :3] + KEY * (light[:, 6:] * self.sun.mean(1)[2]))
        self.ground = mi.Texture2f(mi.TensorXf(lit.reshape(GRID, GRID, 3).astype(np.float32)))
        self.open = FLOOR * (SKY + KEY * self.sun.mean(1)[2])

    def _uncovered(self, asked):
        """Front, back and key light (N, 7) of the vertices ``asked`` (N,); those that another part
        covers, skin below cloth or right along its rim, have what their uncovered neighbours have:
        so no darkness leaks out at a sleeve or a strap.
        """
        p, normal = (on_device(x, mi.Point3f) for x in (self.vertices, self.normals))
        axis, part, covered = (
            dr.normalize(mi.Vector3f(normal)),
            on_device(self.part, mi.UInt32),
            mi.Bool(False),
        )
        frame, around = mi.Frame3f(axis), np.arange(8) * np.pi / 4
        sides = [float(np.cos(a)) * frame.s + float(np.sin(a)) * frame.t for a in around]
        for d, reach in [(axis, _COVER), *((dr.normalize(axis + x), _COVER / 2) for x in sides)]:
            hit = self.scene.ray_intersect_preliminary(mi.Ray3f(p + _LIFT * axis, d))
            other = dr.gather(mi.UInt32, self.part_of_face, hit.prim_index, hit.is_valid())
            covered |= hit.is_valid() & (hit.t < reach) & (other != part)
        seen = ~np.array(covered)
        start, end = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        start, end = np.concatenate([start, end]), np.concatenate([end, start])
        asked, rings = asked.copy(), 2
        for _ in range(rings):
            asked[end[asked[start] & ~seen[start]]] = True
        light = np.zeros((len(asked), 7))
        light[asked] = self._irradiance(self.vertices[asked], self.normals[asked])
        for _ in range(rings):
            give = seen[end] & ~seen[start]
            count = np.bincount(start[give], minlength=len(seen))
            for k in range(light.shape[1]):
                total = np.bincount(start[give], light[end[give], k], len(seen))
                light[:, k] = np.where(count > 0, total / np.maximum(count, 1), light[:, k])
            seen = seen | (count > 0)
        return light

    def _irradiance(self, points, normals):
        """At points (n, 3) with normals (n, 3), in the columns of (n, 7): the sky's irradiance over
        pi on the front and on the back, three each, and the share of the key light that is not
        hidden.
        """
        n = len(points)
        p = on_device(points, mi.Point3f)
        m = on_device(normals, mi.Vector3f)
        sums = dr.zeros(mi.Float, 6 * n)
        index = dr.arange(mi.UInt32, n * self.sky.shape[1])
        point, ray = index % n, index // n
        d = dr.gather(mi.Vector3f, on_device(self.sky.T, mi.Vector3f), ray)
        at, normal = dr.gather(mi.Point3f, p, point), dr.gather(mi.Vector3f, m, point)
        cosine = dr.dot(d, normal)
        side = dr.select(cosine > 0, 1.0, -1.0)
        hidden = self.scene.ray_test(mi.Ray3f(at + side * _LIFT * normal, d))
        # 0, 1, 2: what comes from the sky, the floor, and the meshes themselves
        kind = dr.select(hidden, mi.UInt32(2), dr.select(d.z < 0, mi.UInt32(1), mi.UInt32(0)))
        place = (kind * 2 + dr.select(cosine > 0, mi.UInt32(0), mi.UInt32(1))) * n + point
        dr.scatter_reduce(dr.ReduceOp.Add, sums, dr.abs(cosine), place)
        sky, floor, near = np.array(sums).reshape(3, 2, n, 1)
        total = np.maximum(sky + floor + near, 1e-6)
        found = (sky * SKY + _BOUNCE * (floor * SKY + near * SKY)) / total
        rays = self.sun.shape[1]
        index = dr.arange(mi.UInt32, n * rays)
        point, ray = index % n, index // n
        d = dr.gather(mi.Vector3f, on_device(self.sun.T, mi.Vector3f), ray)
        at, normal = dr.gather(mi.Point3f, p, point), dr.gather(mi.Vector3f, m, point)
        side = dr.select(dr.dot(d, normal) > 0, 1.0, -1.0)
        hidden = self.scene.ray_test(mi.Ray3f(at + side * _LIFT * normal, d))
        key = dr.zeros(mi.Float, n)
        dr.scatter_reduce(dr.ReduceOp.Add, key, dr.select(hidden, 0.0, 1.0 / rays), point)
        return np.column_stack([found[0], found[1], np.array(key)])

    def picture(self, origin, target, size, spp):
        """Image (H, W, 3) uint8 sRGB from ``origin`` [m] towards ``target``."""
        height, width = size
        side = max(1, round(np.sqrt(spp)))
        ahead = np.asarray(target) - origin
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        up = np.cross(right, ahead)
        scale = np.tan(np.deg2rad(_FOV / 2)) / (height / 2)
        x, y = _samples(width, height, side)
        u, v = (x - width / 2) * scale, (height / 2 - y) * scale
        ahead, right, up = (mi.Vector3f(*map(float, x)) for x in (ahead, right, up))
        d = dr.normalize(ahead + u * right + v * up)
        o = mi.Point3f(*map(float, origin))
        hit = self._hit(o, d)
        looked_at = dr.zeros(mi.Bool, len(self.faces))
        dr.scatter(looked_at, mi.Bool(True), hit.prim_index, hit.is_valid())
        asked = np.zeros(len(self.vertices), bool)
        asked[self.faces[np.array(looked_at)]] = True
        self.light(target, asked)
        colour = dr.select(hit.is_valid(), self._cloth(hit, d), self._behind(o, d))
        return _developed(colour, width, height, side)

    def _cloth(self, hit, d):
        normal = dr.normalize(self._mixed(hit, self.normal))
        front = dr.dot(normal, d) < 0
        sky = dr.select(front, self._mixed(hit, self.front), self._mixed(hit, self.back))
        sun = mi.Vector3f(*map(float, self.sun.mean(1)))
        facing = dr.maximum(dr.select(front, 1.0, -1.0) * dr.dot(normal, sun), 0)
        key = mi.Color3f(*map(float, KEY)) * facing * self._mixed(hit, self.shadow)
        return self._mixed(hit, self.colour) * (sky + key)

    def _behind(self, o, d):
        """The floor as its grid is lit, and farther away the open floor, which becomes the sky."""
        distance = (self.floor - o.z) / dr.minimum(d.z, -1e-4)
        at = o + distance * d
        uv = [(at[k] - float(self.centre[k])) / (2 * _REACH) + 0.5 for k in range(2)]
        lit = mi.Color3f(self.ground.eval(mi.Point2f(*uv)))
        edge = dr.maximum(dr.abs(uv[0] - 0.5), dr.abs(uv[1] - 0.5)) * 2
        far = dr.clip((edge - 0.7) / 0.3, 0, 1)
        far = far * far * (3 - 2 * far)
        open_ = mi.Color3f(*map(float, self.open))
        floor = lit + far * (open_ - lit)
        haze = dr.exp(-dr.maximum(distance - 4, 0) / 12)
        haze = dr.select(d.z < 0, haze, 0)
        return mi.Color3f(*map(float, SKY)) * (1 - haze) + floor * haze


def _smooth(vertices, faces, colour):
    """The part with each face cut in four, as :func:`_through` says, if it has fewer than FINE
    faces.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if len(faces) >= FINE:
        return vertices.astype(np.float32), faces, colour
    finer, loop = mesh.subdivided_loop(faces, vertices.shape[1])
    through = _through(faces, loop)
    return np.array([through @ v for v in vertices], np.float32), finer, colour


def _through(faces, loop):
    """The ``loop`` matrix (N', N) of Loop's smooth surface, moved out to the vertices. His own
    passes inside a coarse sleeve by millimetres, and the arm would show. Means over neighbours move
    it, so that small folds stay as smooth as he makes them.
    """
    n = loop.shape[1]
    a, b = mesh.edges_of(faces)[0].T
    around = sparse.coo_array((np.ones(len(a)), (a, b)), (n, n))
    around = (around + around.T).tocsr()
    around /= np.maximum(around.sum(1), 1)[:, None]
    one = sparse.eye_array(n)
    return loop @ (one + around @ (one - loop[:n]))


def _sphere(count):
    """Directions (3, count), evenly spread over the sphere (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z])


def _cap(direction, radius, count):
    """Directions (3, count), evenly spread over a disk of ``radius`` [degrees] around one."""
    k = np.arange(count) + 0.5
    r, turn = np.tan(np.deg2rad(radius)) * np.sqrt(k / count), np.pi * (1 + np.sqrt(5)) * k
    side = np.cross(direction, [0, 0, 1])
    side /= np.linalg.norm(side)
    up = np.cross(side, direction)
    out = direction[:, None] + r * (np.cos(turn) * side[:, None] + np.sin(turn) * up[:, None])
    return out / np.linalg.norm(out, axis=0)
