"""Draping: a trained network, a garment, a motion and a shape make moving cloth;
:func:`onefit.load` is the way in.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias, overload
from weakref import WeakKeyDictionary

import numpy as np
import torch

from onefit.body import AnnyBody, BodyModel, ClosestSurface, skinning
from onefit.contact import Flesh
from onefit.garment import (
    LOOSE,
    TEMPLATES,
    Garment,
    PatchedGarment,
    standard_body,
    untangled,
    waistband,
)
from onefit.motion import Motion
from onefit.network import DEFAULT, Trained
from onefit.network.weights import load as load_weights
from onefit.objective import crossings, posed
from onefit.physics import Material, Settings
from polyfit import mesh
from polyfit.errors import InputError, number
from polyfit.training import device_of

from . import ease, outfit
from .post import PostProcessing, pull

if TYPE_CHECKING:
    from onefit.body import Body
    from onefit.garment import RenderMesh
    from onefit.objective import Measures

FPS = 30.0  # that the networks know
WARM_UP = 10  # frames in which the first pose is held, for the network's memory to settle
BATCH = 16  # frames that go through the network at once
POINTS = 400_000  # vertices times frames, at most, likewise


@dataclass(frozen=True)
class Drape:
    """A draped garment: ``vertices`` (T, N, 3) [m] in the world, ``faces`` (F, 3), ``rest`` (N, 3)
    [m], the garment graded to the shape; the ``body``'s vertices (T, V, 3) [m], its ``body_faces``
    and the root's place ``root`` (T, 3) [m]; ``fps`` frames a second. ``render_mesh``: the mesh of
    the garment's file (:class:`onefit.garment.RenderMesh`); None for a template. ``material``: what
    the cloth is made of; None for a network's drape, which does not know it.
    """

    vertices: torch.Tensor
    faces: torch.Tensor
    rest: torch.Tensor
    body: torch.Tensor
    body_faces: torch.Tensor
    root: torch.Tensor
    fps: float
    render_mesh: RenderMesh | None = None
    material: Material | None = None

    def render_vertices(self) -> np.ndarray:
        """Vertices of the garment's file in each frame, (T, M, 3) [m]; of a template its own."""
        cloth, faces = self.vertices.numpy(), self.faces.numpy()
        if self.render_mesh is None:
            return cloth
        return np.stack([self.render_mesh.carried(x, faces) for x in cloth]).astype(np.float32)

    def measures(self) -> Measures:
        """The :class:`onefit.objective.measures.Measures` of this drape; its masses are those of
        the ``material``, or, without one, of the cloth that networks are trained for.
        """
        from onefit.objective import measure

        return measure(
            self.vertices,
            self.faces,
            self.rest,
            self.body,
            ClosestSurface(self.body[0], self.body_faces),
            self.root,
            self.fps,
            **({"density": self.material.density} if self.material else {}),
        )


@dataclass(frozen=True)
class _Worn:
    """A garment on a body in a motion: ``rest`` (N, 3) [m], graded to the body; ``transforms`` (T,
    J, 3, 4) of the joints.
    """

    garment: Garment
    motion: Motion
    body: Body
    rest: torch.Tensor
    transforms: torch.Tensor


_Named: TypeAlias = Garment | str | os.PathLike[str]
_Several: TypeAlias = list[Any] | tuple[Any, ...]
_Moving: TypeAlias = Motion | str | os.PathLike[str]


class Draper:
    """A trained network and a body model, ready to drape any garment, in any number of threads.
    Made by :func:`onefit.load`.

    Garments are cut into patches once and kept; frames go through in batches. ``device``: where it
    runs. On a body model of another kind than the network was trained on, garments are graded to
    its shapes and the network is told the standard shape.
    """

    def __init__(
        self, trained: Trained, model: BodyModel | None = None, device: torch.device | str = "cpu"
    ) -> None:
        self.trained, self.device = trained, torch.device(device)
        self.network = trained.network.to(self.device).eval()
        self.model = model or AnnyBody()
        self._garments: dict[str, tuple[Any, Garment]] = {}
        # what was made of each garment, by name, as long as that lives
        self._made: WeakKeyDictionary[Garment, dict[str, Any]] = WeakKeyDictionary()
        self._lock = threading.RLock()  # of both
        self._surfaces = threading.local()  # of the body, two for each thread
        # of the last outfit: its garments, the shape, and the vertices at rest that these gave
        self._outfit: tuple = ([], None, [])

    @cached_property
    def standard(self) -> Body:
        """The standard body, which garments are made around."""
        return standard_body()

    def garment(self, garment: Garment | str | os.PathLike[str]) -> Garment:
        """A :class:`Garment` of one, of a template's name, or of a mesh file; names are read once,
        and files where they have changed.
        """
        if isinstance(garment, Garment):
            return garment
        if not isinstance(garment, str | os.PathLike):
            raise InputError(
                f"garment of type {type(garment).__name__}; a Garment (Garment.of_mesh makes one of"
                " arrays), a template's name or a file's is needed"
            )
        name, state = str(garment), None
        if name not in TEMPLATES + LOOSE and os.path.exists(name):
            name, now = os.path.realpath(name), os.stat(name)
            state = now.st_mtime_ns, now.st_size
        with self._lock:
            if name not in self._garments or self._garments[name][0] != state:
                self._garments[name] = state, Garment.named(garment)
            return self._garments[name][1]

    def patched(self, garment: Garment) -> PatchedGarment:
        """The :class:`onefit.PatchedGarment` of a garment, cut once."""
        cut = lambda: PatchedGarment(garment, self.standard, **self.network.patching)
        return self._once(garment, "patched", lambda: cut().to(self.device))

    def _once(self, garment, name, make):
        """What ``make()`` makes of a garment, its ``name``; it must not hold the garment."""
        with self._lock:
            made = self._made.setdefault(garment, {})
            if name not in made:
                made[name] = make()
            return made[name]

    @overload
    def drape(self, garment: _Named, motion: _Moving, *args: Any, **how: Any) -> Drape: ...
    @overload
    def drape(self, garment: _Several, motion: _Moving, *args: Any, **how: Any) -> list[Drape]: ...
    def drape(
        self,
        garment: _Named | _Several,
        motion: _Moving,
        shape: torch.Tensor | None = None,
        *,
        post: bool = True,
        eased: bool = True,
        skinning_only: bool = False,
        advance: Callable[[], object] = lambda: None,
    ) -> Drape | list[Drape]:
        """A :class:`Drape` by the network, in milliseconds a frame: ``garment`` (as :meth:`garment`
        takes it) on the body of ``shape`` (S,) in each frame of ``motion`` (a :class:`Motion` or a
        file of one), at 30 frames a second. With a shape, the way is scaled by the length of its
        legs. A list of garments, in the order in which they are put on, gives a list of drapes:
        each is let out at rest to go over those before it, and ``post`` pushes it out of them.

        ``post``: post-processing (:class:`onefit.draping.post.PostProcessing`): the cloth keeps its
        motion, edges come back towards their lengths at rest, and vertices are pushed out of the
        body. ``eased``: with the garment's :meth:`ease`, which costs seconds once, and nothing a
        frame; without it and ``post``, which a list needs, a drape is what the network alone makes.
        ``skinning_only``: plain skinning of the template, what OneFit is held against, without any
        of these. ``advance`` is called once for each frame that is done. Raises InputError for a
        garment, motion or shape that cannot be used, and for a garment that does not go over
        another.
        """
        if not post and len(outfit.several(garment)) > 1:
            raise InputError("post=False: of several garments only post-processing keeps the order")
        worn, drapes = self._worn(garment, motion, shape), list[Drape]()
        for one in worn:
            post_processed = lambda vertices, *_: vertices
            if post and not skinning_only:
                under = outfit.beneath([(d.vertices, d.faces) for d in drapes]) if drapes else ()
                post_processed = self.post_processing(one.garment, one.rest, one.body, under)
            told = advance if one is worn[-1] else lambda: None
            made = self._draped(one, skinning_only, eased, post_processed, told)
            drapes.append(self._drape_of(one, *made))
        return drapes if isinstance(garment, list | tuple) else drapes[0]

    @overload
    def simulate(self, garment: _Named, motion: _Moving, *args: Any, **how: Any) -> Drape: ...
    @overload
    def simulate(
        self, garment: _Several, motion: _Moving, *args: Any, **how: Any
    ) -> list[Drape]: ...
    def simulate(
        self,
        garment: _Named | _Several,
        motion: _Moving,
        shape: torch.Tensor | None = None,
        *,
        material: Material | str | Sequence[Material | str] = "cotton",
        steps: int = 2,
        settings: Settings | None = None,
        advance: Callable[[], object] = lambda: None,
    ) -> Drape | list[Drape]:
        """A :class:`Drape` by implicit steps of cloth on the garment's own mesh
        (:func:`onefit.draping.simulation.simulated`), in tens of milliseconds a frame, which begins
        with the network's drape and is weakly drawn to it; ``garment``, ``motion``, ``shape`` and
        ``advance`` as in :meth:`drape`. Garments of a list are one sheet, and feel each other.

        ``material``: one of :data:`onefit.physics.MATERIALS` by its name, or a
        :class:`onefit.physics.Material`; a list has one for each garment. ``steps`` a frame, two
        are enough, solved as :class:`onefit.physics.Settings` say. Raises InputError, also for a
        material that there is not, and for another number of materials than of garments.
        """
        from .simulation import simulated

        steps = number("steps", steps, 1, whole=True)
        settings = Settings() if settings is None else settings
        if not isinstance(settings, Settings):
            raise InputError(f"settings = {settings}; onefit.physics.Settings are needed")
        materials = Material.of_each(material, len(outfit.several(garment)))
        worn = self._worn(garment, motion, shape)
        body, moved = worn[0].body, worn[0].motion
        led = moved.led_in(body, settings.lead)
        first = len(led) - len(moved)
        there = skinning.transforms(body, led.poses[:first], led.translation[:first])
        guides = []
        for one in worn:
            guide, moving = self._draped(one)
            if first:
                lead = self._draped(replace(one, transforms=there), skinning_only=True)
                guide, moving = torch.cat([lead[0], guide]), torch.cat([lead[1], moving])
            guides.append(guide)
        if settings.contact.room:
            between = 2 * (len(worn) - 1) * settings.contact.apart
            moving = Flesh(body, settings.contact.room + between)(moving)
        garments, rests = [one.garment for one in worn], [one.rest.cpu() for one in worn]
        faces = [one.faces.cpu() for one in garments]
        patches = [self.patched(one).vertex_patch for one in garments]
        made = simulated(
            torch.cat(outfit.in_order(guides, faces), 1), torch.cat(rests),
            bodies=moving, body_faces=body.faces.cpu(),
            held=np.concatenate([self._held(one) for one in garments]),
            material=materials, of=np.repeat(np.arange(len(faces)), [len(f) for f in faces]),
            steps=steps, fps=FPS, settings=settings, first=first,
            patches=outfit.numbered(patches), **outfit.joined(garments, rests),
        )  # fmt: skip
        vertices = torch.stack([(frame, advance())[0] for frame in made])
        parts = vertices.split([len(rest) for rest in rests], 1)
        each = zip(worn, parts, materials)
        drapes = [self._drape_of(w, x, moving[first:], m) for w, x, m in each]
        return drapes if isinstance(garment, list | tuple) else drapes[0]

    def _worn(self, garment, motion, shape):
        """The :class:`_Worn` of each garment of what :meth:`drape` takes."""
        garments = [self.garment(one) for one in outfit.several(garment)]
        if not isinstance(motion, Motion | str | os.PathLike):
            raise InputError(
                f"motion of type {type(motion).__name__}; a Motion (of poses and translation), or"
                " a file's name, is needed"
            )
        motion = motion if isinstance(motion, Motion) else Motion.read(motion)
        motion = motion.resampled(FPS).to(self.device)
        body = self.model.body(shape)
        rests = self._rests(garments, body)
        body = body.to(self.device)
        motion = motion if shape is None else motion.fitted(body)
        transforms = skinning.transforms(body, motion.poses, motion.translation)
        return [_Worn(one, motion, body, rest, transforms) for one, rest in zip(garments, rests)]

    def _rests(self, garments, body):
        """Vertices at rest (N, 3) [m] of each of the garments, graded to a body, and let out over
        those before it; those of the last outfit are kept, for its other motions.
        """
        graded = lambda: [self._graded(one, body).to(self.device) for one in garments]
        if len(garments) == 1:
            return graded()
        of, shape, rests = self._outfit
        if garments != of or not torch.equal(body.shape, shape):
            rests = outfit.let_out(garments, graded())
            self._outfit = garments, body.shape, rests
        return [rest.clone() for rest in rests]

    def _graded(self, garment, body):
        """The garment's vertices graded to a body, (N, 3) [m]; where layers came through each other
        by that, they are apart again: else they stay so in all of a motion.
        """
        V, F, rest = garment.vertices.cpu(), garment.faces.cpu().numpy(), garment.graded(body)
        clean = lambda: not crossings(V.double().numpy(), F)
        if torch.equal(rest.cpu(), V) or not self._once(garment, "clean", clean):
            return rest
        return torch.as_tensor(untangled(rest.cpu().double().numpy(), F)).to(rest)

    def _draped(
        self,
        worn,
        skinning_only=False,
        eased=True,
        post_processed=lambda vertices, *_: vertices,
        advance=lambda: None,
    ):
        """Vertices (T, N, 3) and the body's (T, V, 3) [m], on the CPU."""
        garment, body, transforms = worn.garment, worn.body, worn.transforms
        offset = self.ease(garment) if eased and not skinning_only else 0
        weights = garment.blend_weights.to(self.device)
        with torch.inference_mode():
            embedding = None if skinning_only else self.embedding(worn.motion, body)

        def batch(first):
            """The drape (n, N, 3) and the bodies (n, V, 3), before post-processing."""
            with torch.inference_mode():
                points, some = (worn.rest + offset)[:, None], slice(first, first + step)
                if embedding is not None:
                    points = points + self._displacement(garment, embedding[some])
                return (
                    posed(points, weights, transforms[some]).transpose(0, 1),
                    skinning.skin(body.vertices, body.blend_weights, transforms[some]).contiguous(),
                )

        step = max(2, min(BATCH, POINTS // len(worn.rest)))
        batches = range(0, len(transforms), step)
        done: list[tuple[torch.Tensor, torch.Tensor]] = []
        with ThreadPoolExecutor(1) as ahead:  # the network does not wait for post-processing
            for vertices, bodies in ahead.map(batch, batches):
                past = done[-1][0][-2:] if done else None
                done.append((post_processed(vertices, bodies, FPS, past), bodies))
                for _ in bodies:
                    advance()
        return [torch.cat(parts).cpu() for parts in zip(*done)]

    def _drape_of(self, worn, vertices, bodies, material=None):
        garment, body = worn.garment, worn.body
        root = skinning.posed_joints(body, worn.transforms)[:, 0]
        found = (vertices, garment.faces, worn.rest, bodies, body.faces, root)
        on_cpu = [x.cpu() for x in found]
        return Drape(*on_cpu, FPS, render_mesh=garment.render_mesh, material=material)

    def _held(self, garment):
        """How firmly each vertex is held at a waistband, (N,)."""
        vertices, faces = garment.vertices.cpu().numpy(), garment.faces.cpu().numpy()
        return waistband.held(vertices, faces, self.standard.joints.numpy())

    def post_processing(
        self,
        garment: Garment,
        rest: torch.Tensor,
        body: Body,
        under: Iterable[Sequence[ClosestSurface]] = (),
    ) -> PostProcessing:
        """The :class:`onefit.draping.post.PostProcessing` of a garment graded to a ``body``, its
        vertices at ``rest`` (N, 3) [m]; ``under``: the surfaces of what it is worn over, besides,
        in one frame after the other.
        """
        if not hasattr(self._surfaces, "two"):
            at, faces = body.vertices.cpu(), body.faces.cpu()
            self._surfaces.two = ClosestSurface(at, faces), ClosestSurface(at, faces)
        edges = mesh.edges_of(garment.faces.cpu().numpy())[0]
        lengths = garment.rest_lengths(torch.as_tensor(edges), rest.cpu())
        if garment.stitches:
            threads, long = garment.stitches.edges(rest.cpu().numpy())
            edges = np.concatenate([edges, threads])
            lengths = torch.cat([lengths, torch.as_tensor(long).to(lengths)])
        pulls = self.pull(garment)
        return PostProcessing(rest, garment.faces, edges, lengths, pulls, self._surfaces.two, under)

    def pull(self, garment: Garment) -> np.ndarray:
        """How firmly post-processing draws each vertex of a garment to the network's drape, (N,)
        [1/s^2], found once: :func:`onefit.draping.post.pull`.
        """
        vertices = garment.vertices.cpu().numpy()
        drawn = lambda: pull(vertices, self.standard, self._held(garment))
        return self._once(garment, "pull", drawn)

    def codes(self, garment: Garment) -> torch.Tensor:
        """Z_T (K, width) of the garment's patches, found once."""

        def encoded():
            joints = self.standard.joints.to(self.device)
            with torch.no_grad():
                return self.network.patches(*self.patched(garment).features, joints)

        return self._once(garment, "codes", encoded)

    def _displacement(self, garment, embedding):
        """Displacements of the vertices in the rest space, (N, T, 3) [m], for embeddings (T,
        width).
        """
        patched = self.patched(garment)
        return patched.displacement(
            patched.changes(self.network.decoder(self.codes(garment), embedding))
        )

    def ease(self, garment: Garment) -> torch.Tensor:
        """The offset of the garment's vertices in the rest space, (N, 3) [m], found once:
        :func:`onefit.draping.ease.ease`.
        """

        def found():
            rest, body = garment.vertices.to(self.device), self.standard.to(self.device)
            with torch.no_grad():
                return ease.ease(rest, garment.faces, body, self._trial(garment, rest, body))

        return self._once(garment, "ease", found)

    def _trial(self, garment, rest, body):
        """The frames that :func:`onefit.draping.ease.ease` looks at, of ``rest`` (N, 3) [m] on the
        standard ``body``: vertices as the network drapes them and as plain skinning does (N, 3),
        and the body's (V, 3) [m].
        """
        weights = garment.blend_weights.to(self.device)
        for kind in ease.MOTIONS:
            motion = Motion.generate(kind, seconds=ease.SECONDS, fps=FPS).to(self.device)
            transforms = skinning.transforms(body, motion.poses, motion.translation)[
                :: ease.FRAME_STEP
            ]
            displacement = self._displacement(
                garment, self.embedding(motion, body)[:: ease.FRAME_STEP]
            )
            draped, skinned = (
                posed(x, weights, transforms).transpose(0, 1)
                for x in (rest[:, None] + displacement, rest[:, None])
            )
            yield from zip(
                draped, skinned, skinning.skin(body.vertices, body.blend_weights, transforms)
            )

    def embedding(self, motion: Motion, body: Body) -> torch.Tensor:
        """Z_B (T, width) of the motion, after the first pose was held for a while."""
        hold = lambda x: torch.cat([x[:1].expand(WARM_UP, *x.shape[1:]), x])[None]
        known = body.kind == self.trained.body == self.model.kind
        shape = (
            body.shape - self.model.standard_shape.to(self.device)
            if known
            else torch.zeros(self.network.shape["shape"], device=self.device)
        )
        return self.network.body(hold(motion.poses), hold(motion.translation), shape[None], FPS)[0][
            0, WARM_UP:
        ]


def load(
    name: str | os.PathLike[str] = DEFAULT,
    *,
    model: BodyModel | None = None,
    device: torch.device | str = "cpu",
) -> Draper:
    """The :class:`Draper` of a network: ``name`` of one that comes with the package
    (:func:`onefit.pretrained`), or a file of weights.

    ``model``: a body model, by default :class:`onefit.AnnyBody`; ``device``: "cpu" or "cuda", or
    one of several as "cuda:1". Raises InputError.
    """
    if not (model is None or isinstance(model, BodyModel)):
        raise InputError(f"model = {model!r}; a body model, as onefit.AnnyBody(), is needed")
    return Draper(load_weights(name), model, device_of(str(device)))
