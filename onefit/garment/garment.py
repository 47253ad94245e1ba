"""Garments in the rest space of the standard body: templates and files, with blend weights, graded
to the body's shapes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from onefit.body import Body, ClosestSurface
from polyfit import mesh
from polyfit.errors import InputError, as_number
from polyfit.files import as_path
from polyfit.mesh import TexCoords, read_textured

from . import fitting, remesh
from .binding import Binding, standard_body, standard_surface
from .reading import RenderMesh, Stitches, check, mended, stitched

TEMPLATES = (
    "tshirt",
    "dress",
    "tank",
    "long_sleeve_top",
    "shorts",
    "trousers",
    "jumpsuit",
    "skirt",
)
# Garments with slack: a cut that fell once
LOOSE = ("boxy_tshirt", "shirt", "waisted_dress", "circle_skirt", "wide_trousers")
_MOST_VERTICES = 1_000_000
FOLDER = Path(__file__).parents[1] / "data" / "garments"


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment at rest on the standard body.

    ``name``; ``vertices`` (N, 3) float32 [m], in OneFit's axes; ``faces`` (F, 3) int64, wound
    outwards; ``blend_weights`` (N, 24), rows that sum to one; ``repairs``, sentences on what was
    changed when it was read. ``cut`` (N, 3) float32 [m]: the cloth as it was cut, before it fell
    and hung in folds, whose lengths are its lengths at rest; None: the garment is its own cut.
    ``render_mesh``: the mesh of the file that the garment was read from, which it carries; None for
    a template. ``stitches``: what its buttons and buckles hold together. ``lengths`` (F, 3) float32
    [m]: the faces' sides at rest, of cloth that was sewn of panels; its ``cut`` only tells then
    which parts are near to each other.
    """

    name: str
    vertices: torch.Tensor
    faces: torch.Tensor
    blend_weights: torch.Tensor
    repairs: tuple = ()
    cut: torch.Tensor | None = None
    render_mesh: RenderMesh | None = field(default=None, repr=False)
    stitches: Stitches | None = field(default=None, repr=False)
    lengths: torch.Tensor | None = field(default=None, repr=False)
    _binding: Any = field(default=None, repr=False)

    @classmethod
    def template(cls, name: str) -> Garment:
        """One of :data:`TEMPLATES` or :data:`LOOSE`, which :mod:`onefit.tailor` made."""
        if name not in TEMPLATES + LOOSE:
            raise InputError(
                f"garment '{name}': no such template; there are {', '.join(TEMPLATES + LOOSE)}"
            )
        with np.load(FOLDER / f"{name}.npz") as file:
            return cls.bound(name, file["vertices"], file["faces"], cut=file.get("cut"))

    @classmethod
    def named(cls, name: str | os.PathLike[str], **options: Any) -> Garment:
        """A template by its name, of which ``count`` vertices can be asked, or else the garment of
        a mesh file, with the ``options`` of :meth:`read`. Raises InputError.
        """
        name = as_path(name, "garment")
        if name in TEMPLATES + LOOSE:
            if other := [option for option in options if option != "count"]:
                raise InputError(f"garment '{name}': {other[0]} is for files; this is a template")
            garment, count = cls.template(name), options.get("count")
            return garment if count is None else garment.remeshed(count)
        if not Path(name).suffix and not Path(name).exists():
            raise InputError(
                f"garment '{name}': no such template; there are {', '.join(TEMPLATES + LOOSE)}; or"
                " give an .obj, .ply or .glb file, or a sewing pattern (.json)"
            )
        return cls.read(name, **options)

    @classmethod
    def all_named(
        cls, names: Iterable[str | os.PathLike[str]], count: int | None = None, **options: Any
    ) -> list[Garment]:
        """:meth:`named` of each; the ``options`` but ``count`` are for those that are files."""
        of = lambda name: {} if name in TEMPLATES + LOOSE else options
        return [cls.named(name, count=count, **of(name)) for name in names]

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        name: str | None = None,
        made_for: Body | str | None = None,
        loose: bool = False,
        scale: float = 1.0,
        up: str | None = None,
        turn: float = 0.0,
        offset: Any = (0.0, 0.0, 0.0),
        count: int | None = None,
    ) -> Garment:
        """The garment of an OBJ, PLY or GLB file of triangles or quads, repaired by the rules of
        :mod:`onefit.garment.reading.mending`; or of a sewing pattern, GarmentCode's
        ``*_specification.json``, which is sewn (:mod:`onefit.garment.sewing.seams`), in half a
        minute. ``count``: about how many vertices it shall have; of a mesh by default its own.

        ``scale``, ``up``, ``turn`` [degrees], ``offset`` [m]: as in
        :func:`onefit.garment.fitting.placed`, from the file's units and axes to metres and
        OneFit's; without ``up``, y is up in glTF and z in others. ``made_for``: the
        :class:`~onefit.Body` on which it lies, if that is not the standard body, or "T-pose" for
        the standard body in the T-pose; the garment is brought to the standard body as
        :func:`onefit.garment.fitting.to_standard` says, and ``loose`` (skirts, dresses) leaves the
        legs' pose out. A pattern says itself where it lies: of all these it takes ``made_for``, a
        Body in the standard stand, by default one of GarmentCode's mean size. Raises InputError, in
        one line, for a mesh that is no garment or does not lie on the body.
        """
        extension = Path(as_path(path, "garment")).suffix.lower()
        _check_count(count)
        if extension == ".json":
            plain = (False, 1.0, None, 0.0, (0.0, 0.0, 0.0))
            if (loose, scale, up, turn, tuple(np.ravel(offset))) != plain:
                raise InputError(
                    f"{path}: scale, up, turn, offset and loose are for meshes; a sewing pattern"
                    " says its unit and place itself"
                )
            return cls._sewn(path, name, made_for, count)
        if extension not in (".obj", ".ply", ".glb", ".gltf") and not Path(path).is_dir():
            raise InputError(
                f"{path}: garment of type '{extension}'; a mesh (.obj, .ply or .glb) or a sewing"
                " pattern (.json) is needed"
            )
        V, F, texcoords = read_textured(path, "garment")
        axis, where = fitting.up_of(path, up), str(path)
        if axis != (up or "z"):
            where += " (read with y up, as glTF has it; else up='z', or --up z)"
        place = fitting.Place(scale, axis, turn, offset, fitting.up_of(path))
        garment = cls._of_mesh(
            name or Path(path).stem, place.apply(V), F, texcoords, made_for, loose, where, place
        )
        return garment if count is None else garment.remeshed(count)

    @classmethod
    def _sewn(cls, path, name, made_for, count):
        from .sewing.seams import sewn

        _check_count(count)
        if made_for is not None and not isinstance(made_for, Body):
            raise InputError(
                f"{path}: made_for={made_for!r}; of a sewing pattern a Body is needed, or no"
                " --made-for"
            )
        made = sewn(path, count, made_for)
        V, F, flat = made.vertices, made.cut.faces, made.cut.panels
        places, of = np.unique(flat.reshape(-1, 2), axis=0, return_inverse=True)
        texcoords = TexCoords(places / places.max(), of.reshape(-1, 3))
        seen = RenderMesh.bound(V, F, texcoords, V, F)
        of_cut = made.cut.vertices, seen, made.lengths
        return cls.bound(name or made.name, V, F, made.repairs, *of_cut)

    @classmethod
    def of_mesh(
        cls,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        texcoords: TexCoords | None = None,
        *,
        made_for: Body | str | None = None,
        loose: bool = False,
        where: str = "garment",
    ) -> Garment:
        """The garment of any triangle mesh (N, 3) [m], (F, 3) in OneFit's axes, anything like
        arrays, with its texture coordinates or None; otherwise as :meth:`read`.
        """
        return cls._of_mesh(name, vertices, faces, texcoords, made_for, loose, where)

    @classmethod
    def _of_mesh(cls, name, vertices, faces, texcoords, made_for, loose, where, place=None):
        other = fitting.t_stand() if made_for is None else None
        if isinstance(made_for, str) and made_for == fitting.T_POSE:
            made_for, other = fitting.t_posed(), fitting.lowered_stand()
        if made_for is not None and not isinstance(made_for, Body):
            raise InputError(
                f"{where}: made_for={made_for!r}; a Body or '{fitting.T_POSE}' is needed"
            )
        if not isinstance(texcoords, TexCoords | None):
            raise InputError(
                f"{where}: texcoords of type {type(texcoords).__name__}; a TexCoords"
                " (polyfit.mesh.TexCoords) is needed, or None"
            )
        surface = standard_surface() if made_for is None else fitting.surface_of(made_for)
        vertices, faces = mesh.as_arrays(vertices, faces, where)
        check(vertices, faces, where)
        if texcoords is not None:
            texcoords.check(len(faces), where)
        fitting.check_place(vertices[np.unique(faces)], surface, where, other, place)
        V, F, told = mended(vertices, faces, where, surface)
        fitting.check_reach(V, surface, where)
        turned = fitting.inward(V, F, surface)
        if turned.any():
            F = np.where(turned[:, None], F[:, ::-1], F)
            told += (f"turned {turned.sum()} faces that were wound inwards",)
        if texcoords is not None and (bare := (texcoords.faces < 0).any(axis=1)).any():
            told += (f"{bare.sum()} faces have no texture coordinates, and take (0, 0)",)
        render_mesh = RenderMesh.bound(vertices, faces, texcoords, V, F)
        if made_for is not None:
            V = fitting.to_standard(V, F, made_for.to("cpu"), loose)
        V, pushed = fitting.pushed_out(V, F, where)
        return cls.bound(name, V, F, told + pushed, render_mesh=render_mesh)

    @classmethod
    def bound(
        cls,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        repairs: tuple = (),
        cut: np.ndarray | None = None,
        render_mesh: RenderMesh | None = None,
        lengths: np.ndarray | None = None,
    ) -> Garment:
        """The garment of a clean mesh (N, 3) [m], (F, 3) around the standard body, with blend
        weights from there; ``cut``, ``render_mesh`` and ``lengths`` as in the class. Buttons and
        buckles of the ``render_mesh`` become stitches.
        """
        V, F = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        binding = Binding(V, F)
        weights = torch.as_tensor(
            binding.blend_weights(standard_body().blend_weights.numpy()), dtype=torch.float32
        )
        return cls(
            name,
            torch.as_tensor(V, dtype=torch.float32),
            torch.as_tensor(F),
            weights,
            tuple(repairs),
            None if cut is None else torch.as_tensor(cut, dtype=torch.float32),
            render_mesh,
            None if render_mesh is None else stitched(render_mesh, V, F),
            None if lengths is None else torch.as_tensor(lengths, dtype=torch.float32),
            binding,
        )

    def __len__(self):
        return len(self.vertices)

    def to(self, device: torch.device | str) -> Garment:
        """The same garment with its tensors on ``device``."""
        moved: dict[str, Any] = {
            f.name: v.to(device)
            for f in fields(self)
            if isinstance(v := getattr(self, f.name), torch.Tensor)
        }
        return replace(self, **moved)

    def graded(self, body: Body) -> torch.Tensor:
        """Rest vertices (N, 3) [m] moved with the shape of ``body``: a Body in the standard stand.
        The standard shape leaves them where they are. Raises InputError for a garment that is not
        bound to the standard body.
        """
        if self._binding is None:
            raise InputError(
                f"garment '{self.name}': made by its constructor; Garment.of_mesh makes one that"
                " can be worn"
            )
        rest = self.vertices.cpu().double().numpy()
        moved = self._binding.moved(
            rest, standard_body().vertices.double().numpy(), fitting.standard_on(body)
        )
        return torch.as_tensor(moved, dtype=torch.float32, device=self.vertices.device)

    def rest_lengths(self, pairs: torch.Tensor, graded: torch.Tensor | None = None) -> torch.Tensor:
        """Lengths at rest (E,) [m] between the vertices of ``pairs`` (E, 2), each the corners of a
        face: those of the cut, or of the garment itself; along a seam of panels, the mean of both
        sides. With ``graded`` (N, 3) [m], from :meth:`graded`, as much longer as that has made
        them.
        """
        length = lambda x: (x[pairs[:, 0]] - x[pairs[:, 1]]).norm(dim=-1)
        if self.cut is None:
            return length(self.vertices if graded is None else graded)
        cut = length(self.cut) if self.lengths is None else self._lengths_of(pairs)
        return cut if graded is None else cut * length(graded) / length(self.vertices)

    def sides(self, graded: torch.Tensor | None = None) -> torch.Tensor:
        """:meth:`rest_lengths` (F, 3) [m] of the faces' sides, from each corner to the next; along
        a seam of panels, each face has its own.
        """
        if self.lengths is not None:
            side = lambda x: (x[self.faces.roll(-1, 1)] - x[self.faces]).norm(dim=-1)
            return self.lengths * (1 if graded is None else side(graded) / side(self.vertices))
        pairs = torch.stack([self.faces, self.faces.roll(-1, 1)], -1)
        return self.rest_lengths(pairs.reshape(-1, 2), graded).reshape(-1, 3)

    def _lengths_of(self, pairs):
        """The lengths at rest (E,) of ``pairs`` (E, 2), sides of faces, by those of the faces."""
        edges, side = mesh.edges_of(self.faces.cpu().numpy())
        lengths = self.lengths.cpu().numpy().ravel()
        mean = np.bincount(side.ravel(), lengths) / np.bincount(side.ravel())
        key = lambda e: e.min(1).astype(np.int64) * len(self) + e.max(1)
        order = np.argsort(key(edges))
        at = order[np.searchsorted(key(edges)[order], key(pairs.cpu().numpy()))]
        return torch.as_tensor(mean[at]).to(self.lengths)

    def remeshed(self, count: int) -> Garment:
        """The same garment with about ``count`` vertices: every face is cut in four as often as is
        needed for 0.7 times as many; where there are more than 1.4 times as many, even triangles
        are made anew (ACVD). Raises InputError for so few that a sleeve or a leg closes, and for a
        garment that was sewn of panels: :meth:`read` takes the ``count`` there.
        """
        _check_count(count)
        if self.lengths is not None:
            raise InputError(
                f"{self.name}: sewn of panels: Garment.read(..., count={count}) sews it anew"
            )
        V, F = self.vertices.cpu().double().numpy(), self.faces.cpu().numpy()
        cut = None if self.cut is None else self.cut.cpu().double().numpy()
        while len(V) < 0.7 * count:
            F, edges = mesh.subdivided(F)
            finer = lambda x: np.concatenate([x, x[edges].mean(axis=1)])
            V, cut = finer(V), None if cut is None else finer(cut)
        if len(V) > 1.4 * count:
            if cut is None:
                V, F = remesh.remeshed(V, F, count)
            else:  # the cut has no folds, in which a point is near to many
                W, G = cut, F
                cut, F = remesh.remeshed(W, G, count)
                at = ClosestSurface(W, G)(cut)
                V = np.einsum("nk,nkd->nd", at.barycentric, V[G[at.face]])
            remesh.check(V if cut is None else cut, F, self.name, count)
        V, pushed = fitting.pushed_out(V, F, self.name)
        render_mesh = self.render_mesh and self.render_mesh.rebound(
            self.vertices.cpu().numpy(), self.faces.cpu().numpy(), V, F
        )
        return Garment.bound(self.name, V, F, self.repairs + pushed, cut, render_mesh)


def _check_count(count):
    """Raises InputError for a number of vertices that no garment can have; None says none."""
    if count is not None and not 100 <= as_number(count) <= _MOST_VERTICES:
        raise InputError(f"count = {count}: 100 to {_MOST_VERTICES:,} vertices are needed")
