"""Cloth on a moving body by Newton's vertex block descent (VBD): the reference that OneFit is held
against. No code is shared with :mod:`onefit.physics` but the material.

    pip install newton          # for the benchmarks only

The body is a mesh that moves and takes cloth along by friction. Cloth meets it with its vertices,
and itself with vertices, edges and faces. Air resists by pressure.
"""

from dataclasses import asdict, dataclass

import numpy as np

from onefit.physics.material import AIR, GRAVITY
from polyfit.errors import InputError


@dataclass(frozen=True)
class Settings:
    """``substeps`` of a frame at 30 frames a second, ``iterations`` of VBD in each; ``lead`` [s]:
    the body comes from its rest to the first pose, and ``hold`` [s]: it stays there, before the
    motion starts; ``gap`` [m] between cloth and skin; ``contact`` stiffness [N/m] of a vertex on
    the body, which is looked for as far as ``reach`` [m]; ``damping`` of stretch and bending, as a
    time [s] times their stiffness; ``self_gap`` [m] at which cloth meets itself, 0 for cloth that
    does not.
    """

    substeps: int = 10
    iterations: int = 40
    lead: float = 0.6
    hold: float = 0.2
    gap: float = 0.004
    contact: float = 1000.0
    reach: float = 0.03
    damping: float = 2e-4
    self_gap: float = 0.002


def flattened(sides):
    """Matrices (F, 2, 2) [m] whose columns are the sides from corner 0 to 1 and from 0 to 2 of
    triangles laid flat, of the lengths ``sides`` (F, 3) of 01, 12, 20.
    """
    a, b, c = sides.T
    x = (a * a + c * c - b * b) / (2 * a)
    y = np.sqrt(np.maximum(c * c - x * x, 1e-12))
    return np.stack([np.stack([a, x], 1), np.stack([0 * a, y], 1)], 1)


def hinges(edges, faces, sides, bending):
    """Lengths at rest (E,) [m] of Newton's ``edges`` (E, 4), the two opposite vertices (-1: none)
    and then the edge's own; and what Newton multiplies with them and half of the squared angles
    [N], for a sheet of ``bending`` stiffness [N m]: B l / A, A the area of the edge's two faces
    (Grinspun et al., *Discrete Shells*, 2003, with the factor that makes a cylinder cost B / 2
    curvature^2 an area).
    """
    size = faces.max() + 1
    key = lambda a, b: np.minimum(a, b).astype(np.int64) * size + np.maximum(a, b)
    side = key(faces, np.roll(faces, -1, axis=1)).ravel()
    known, first, number = np.unique(side, return_index=True, return_inverse=True)
    area = np.repeat(np.linalg.det(flattened(sides)) / 2, 3)
    around = np.bincount(number, area)
    at = np.searchsorted(known, key(edges[:, 2], edges[:, 3]))
    length = sides.ravel()[first][at]
    return length, bending * length / around[at]


def between(frames, time):
    """Values and their slopes a frame at the fractional frame ``time`` of (T, N, 3) arrays: a cubic
    through the frames with the slopes of central differences.
    """
    last = len(frames) - 1
    k = min(int(time), last - 1)
    s = time - k
    a, b = frames[k].astype(np.float64), frames[k + 1].astype(np.float64)
    da, db = (b - frames[max(k - 1, 0)]) / 2, (frames[min(k + 2, last)] - a) / 2
    c2, c3 = 3 * (b - a) - 2 * da - db, da + db - 2 * (b - a)
    return a + s * (da + s * (c2 + s * c3)), da + s * (2 * c2 + 3 * s * c3)


def pressure(x, v, faces, drag):
    """Force of still air on each vertex (N, 3) [N], of positions ``x`` and velocities ``v`` (N, 3):
    drag / 2 times the air's density, area and squared velocity along the faces' normals.
    """
    a, b, c = (x[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(double, 1e-12)
    speed = (v[faces].mean(1) * normal).sum(1, keepdims=True)
    force = -drag * AIR / 4 * double * speed * np.abs(speed) * normal / 3
    return np.stack(
        [np.bincount(faces.ravel(), np.repeat(force[:, k], 3), len(x)) for k in range(3)], 1
    )


class Simulation:
    """Cloth of ``material`` that starts at ``vertices`` (N, 3) [m] with ``faces`` (F, 3), whose
    ``sides`` (F, 3) [m], from corner k to the next, are their lengths at rest; it rests flat. On
    ``body`` (V, 3) [m] with ``body_faces``. ``held`` (N,) bool: vertices that are moved.
    """

    def __init__(self, vertices, faces, sides, held, body, body_faces, material, settings):
        try:
            import newton
            import warp as wp
        except ImportError:
            raise InputError("newton is not installed; 'pip install newton' brings it") from None
        wp.config.quiet = True
        self.material, self.settings, self.faces = material, settings, faces
        self.held = np.flatnonzero(held)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=wp.vec3(0, 0, -GRAVITY))
        lame = material.stretch / 2  # a sheet that does not narrow as it is pulled
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0), rot=wp.quat_identity(), vel=wp.vec3(0.0), scale=1.0,
            vertices=list(vertices.astype(np.float64)), indices=faces.ravel().tolist(),
            density=material.density, tri_ke=lame, tri_ka=0.0, tri_kd=settings.damping * lame,
            edge_ke=0.0, edge_kd=0.0, particle_radius=settings.gap,
        )  # fmt: skip
        flat = flattened(sides)
        area = np.linalg.det(flat) / 2
        mass = material.density * np.bincount(faces.ravel(), np.repeat(area / 3, 3))
        builder.tri_poses, builder.tri_areas = np.linalg.inv(flat).tolist(), area.tolist()
        builder.particle_mass = mass.tolist()
        edges = np.array(builder.edge_indices)
        length, stiffness = hinges(edges, faces, sides, material.bending)
        builder.edge_rest_length, builder.edge_rest_angle = length.tolist(), [0.0] * len(edges)
        builder.edge_bending_properties = [(k, settings.damping * k) for k in stiffness]
        for i in self.held:
            builder.particle_mass[i] = 0.0
            builder.particle_flags[i] &= ~int(newton.ParticleFlags.ACTIVE)
        skin = newton.Mesh(body.astype(np.float32), body_faces.ravel().astype(np.int32))
        config = newton.ModelBuilder.ShapeConfig(
            ke=settings.contact, kd=0.0, mu=material.friction, margin=0.0
        )
        builder.add_shape_mesh(-1, mesh=skin, cfg=config)
        builder.color()
        self.model = builder.finalize(device="cpu")
        self.model.soft_contact_ke, self.model.soft_contact_kd = settings.contact, 0.0
        self.model.soft_contact_mu = material.friction
        # the body leaves the box that Newton found it in
        self.model.shape_collision_aabb_lower.fill_(wp.vec3(-100.0))
        self.model.shape_collision_aabb_upper.fill_(wp.vec3(100.0))
        self.skin = skin.mesh
        self.pipeline = newton.CollisionPipeline(self.model, soft_contact_gap=settings.reach)
        self.contacts = self.pipeline.contacts()
        itself = dict(
            particle_enable_self_contact=True,
            particle_self_contact_margin=settings.self_gap,
            particle_self_contact_gap=settings.self_gap,
        )
        self.solver = newton.solvers.SolverVBD(
            self.model, iterations=settings.iterations, **(itself if settings.self_gap else {})
        )
        self.now, self.after = self.model.state(), self.model.state()
        self.control = self.model.control()

    def frame(self, body, held, time, fps):
        """One frame on, from the frame ``time`` of ``body`` (T, V, 3) and ``held`` (T, H, 3): the
        vertices (N, 3) [m] then.
        """
        dt = 1 / fps / self.settings.substeps
        for step in range(self.settings.substeps):
            at = time + (step + 1) / self.settings.substeps
            surface, speed = between(body, at)
            self.skin.points.assign(surface.astype(np.float32))
            self.skin.velocities.assign((speed * fps).astype(np.float32))
            self.skin.refit()
            x, v = self.now.particle_q.numpy(), self.now.particle_qd.numpy()
            if len(self.held):
                x[self.held], v[self.held] = between(held, at)[0], 0.0
                self.now.particle_q.assign(x)
                self.now.particle_qd.assign(v)
            self.now.clear_forces()
            force = pressure(x.astype(np.float64), v, self.faces, self.material.drag)
            self.now.particle_f.assign(force.astype(np.float32))
            self.pipeline.collide(self.now, self.contacts)
            self.solver.step(self.now, self.after, self.control, self.contacts, dt)
            self.now, self.after = self.after, self.now
        return self.now.particle_q.numpy().astype(np.float64)

    @property
    def state(self):
        """Positions and velocities (2, N, 3)."""
        return np.stack([self.now.particle_q.numpy(), self.now.particle_qd.numpy()])

    @state.setter
    def state(self, both):
        self.now.particle_q.assign(both[0].astype(np.float32))
        self.now.particle_qd.assign(both[1].astype(np.float32))


def description(material, settings):
    """What a simulation was made with, to tell it from others: a dict of numbers."""
    return {"material": asdict(material), "settings": asdict(settings)}
