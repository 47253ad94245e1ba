"""The problem that a solver solves: unknowns of a window of frames in, the objective out.

It knows the scene, the template's patch, the images and the weights; it knows nothing of how it is
minimised. Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from polysft_mi.errors import BadFrame, InputError
from polysft_mi.render import Pinhole, RasterIntegrator, interruptible
from polysft_mi.scene import Rules
from polysft_mi.surface import JetAtlas, Unknowns

from . import terms as objective
from .volume import Volume

if TYPE_CHECKING:
    from polysft_mi.scene import Experiment, Sequence

TERMS = ("rgb", "silhouette", "inextensibility", "temporal")
_CACHED_FRAMES = 8


def _positions_key(params, mesh):
    """The key of the mesh's vertex positions among a scene's parameters. (Mitsuba names meshes by
    id, or by address where they have none.)
    """
    keys = [k for k in params.keys() if k.endswith("vertex_positions")]
    for key in keys:
        if len(keys) == 1 or key.split(".")[0] == mesh.id():
            return key
    raise InputError(
        f"template {mesh.id()!r}: not found among the scene's parameters; give its shape"
        ' id="template"'
    )


@dataclass
class Target:
    """One image on the device: ``rgb`` (H, W, 3), cut out by the mask where there is one; ``mask``
    Float of P or None; ``area`` [pixels].
    """

    rgb: mi.TensorXf
    mask: mi.Float | None
    area: mi.Float | None


class Problem:
    """Shape from template on one video.

    ``experiment``: :class:`polysft_mi.scene.experiment.Experiment`; ``sequence``:
    :class:`polysft_mi.scene.sequence.Sequence`.
    """

    def __init__(
        self, experiment: Experiment, sequence: Sequence, rules: Rules | None = None
    ) -> None:
        self.experiment, self.sequence, self.settings = experiment, sequence, experiment.settings
        self.template = experiment.template
        self.rules = (rules or Rules()).for_patches(len(self.template))
        self.patch = JetAtlas(self.template)
        self.width, self.height = experiment.size
        self.pixels = self.width * self.height
        edges = self.template.edges
        self.edges = tuple(
            mi.UInt32(np.ascontiguousarray(edges[:, k], dtype=np.uint32)) for k in (0, 1)
        )
        rest = self.surface(self.patch.rest()).astype(np.float64)
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        self.edge_lengths = mi.Float(lengths.astype(np.float32))
        self.volume = self._kept_volume()
        self._corner = mi.UInt32(experiment.corner.astype(np.uint32))
        self._identity = np.array_equal(experiment.corner, np.arange(len(self.template.vertices)))
        # through the scene, not the mesh alone: only so does the scene rebuild what it traces rays
        # with
        self._params = mi.traverse(experiment.scene)
        self._key = _positions_key(self._params, experiment.mesh)
        self._targets: OrderedDict[int, Target] = OrderedDict()
        self.texcoords: np.ndarray | None = None
        self.camera = Pinhole(experiment.sensor)
        self._setup_renderer()

    def _kept_volume(self):
        """What the volume costs, None where it is free; InputError where the template is open."""
        if self.settings.k_volume == 0:
            return None
        if not self.template.is_closed:
            raise InputError(
                f"{self.experiment.path}: k_volume = {self.settings.k_volume:g}, but the template"
                " is open and has no volume; 0 is right"
            )
        return Volume(self.template)

    # -- rendering ----------------------------------------------------------

    def _setup_renderer(self):
        renderer = self.experiment.renderer
        renderer.hide_emitters = (
            True  # what is behind the surface is black, with a silhouette's gradient towards black
        )
        self._raster = isinstance(renderer, RasterIntegrator)
        self._mask_renderer = None
        if not self._raster:
            if not str(self.experiment.sensor).startswith("PerspectiveCamera"):
                raise InputError(
                    f"{self.experiment.path}: {renderer.class_name()} takes Mitsuba's perspective"
                    " sensor only (fx = fy); use raster"
                )
            self._mask_renderer = mi.load_dict({"type": "silhouette_projective"})

    def place(self, vertices: mi.Point3f) -> None:
        """Put the surface (Point3f of N, attached or not) into the scene."""
        points = vertices
        if (
            not self._identity
        ):  # in double, as wherever gradients are summed (objective.edge_lengths)
            points = mi.Point3f(dr.gather(mi.Point3d, mi.Float64(dr.ravel(vertices)), self._corner))
        self._params[self._key] = dr.ravel(points)
        self._params.update()

    def set_texcoords(self, texcoords: mi.Float) -> None:
        """Replace the template's texture coordinates (Float of 2V, in the order of the rendered
        mesh); ``texcoords`` (NumPy) tells them.
        """
        self.texcoords = np.array(texcoords)
        key = self._key.removesuffix("positions") + "texcoords"
        self._params[key] = texcoords
        self._params.update()

    def image(self, vertices: mi.Point3f, seed: int = 0) -> tuple[mi.TensorXf, mi.Float]:
        """Render the surface: (rgb tensor (H, W, 3), alpha Float of P), attached to the
        vertices.
        """
        self.place(vertices)
        renderer: Any = self.experiment.renderer
        scene, sensor, spp = self.experiment.scene, self.experiment.sensor, self.settings.spp
        if self._raster:
            image = renderer.image(scene, sensor, seed, spp)
            alpha = None
        else:
            image = mi.render(
                scene,
                self._params,
                sensor=sensor,
                integrator=self.experiment.renderer,
                spp=spp,
                seed=seed,
            )
            mask = mi.render(
                scene,
                self._params,
                sensor=sensor,
                integrator=self._mask_renderer,
                spp=max(spp, 16),
                seed=~seed & 0xFFFFFFFF,
            )
            alpha = dr.gather(
                mi.Float, mask.array, dr.arange(mi.UInt32, self.pixels) * mask.shape[2]
            )
        channels = image.shape[2]
        pixel = dr.arange(mi.UInt32, 3 * self.pixels)
        rgb = dr.gather(
            mi.Float, image.array, pixel // 3 * channels + pixel % 3, mode=dr.ReduceMode.Permute
        )
        if alpha is None:
            alpha = dr.gather(
                mi.Float,
                image.array,
                dr.arange(mi.UInt32, self.pixels) * channels + 3,
                mode=dr.ReduceMode.Permute,
            )
        return mi.TensorXf(rgb, (self.height, self.width, 3)), alpha

    # -- images -------------------------------------------------------------

    def target(self, frame: int) -> Target:
        """The image of the frame (counted in the selection), as the objective wants it."""
        if frame not in self._targets:
            rgb, mask = self.sequence.frame(frame), self.sequence.mask(frame)
            if mask is not None:
                rgb = rgb * mask[..., None]
            tensor = mi.TensorXf(np.ascontiguousarray(rgb, dtype=np.float32))
            if mask is not None:
                tensor = objective.blur(tensor, self.settings.blur)
            area = mi.Float(max(1.0, float(mask.sum()))) if mask is not None else None
            device_mask = (
                mi.Float(np.ascontiguousarray(mask, dtype=np.float32).ravel())
                if mask is not None
                else None
            )
            if device_mask is not None and self.settings.lighting == "local":
                tensor = objective.normalise_locally(tensor, self._weight_image(device_mask))
            dr.eval(tensor, area, device_mask)
            self._targets[frame] = Target(tensor, device_mask, area)
            while len(self._targets) > _CACHED_FRAMES:
                self._targets.popitem(last=False)
        return self._targets[frame]

    def _weight_image(self, weight):
        return mi.TensorXf(weight, (self.height, self.width, 1))

    # -- objective ----------------------------------------------------------

    def frame_terms(self, unknowns: Unknowns, frame: int, seed: int = 0) -> dict[str, mi.Float]:
        """The weighted per-frame terms of the objective, name to Float of 1, attached."""
        s = self.settings
        vertices = self.patch.vertices(unknowns)
        rgb, alpha = self.image(vertices, seed)
        target = self.target(frame)
        terms = {}
        if target.mask is not None:
            weight, area = dr.ones(mi.Float, self.pixels), target.area
            terms["silhouette"] = s.k_silhouette * objective.silhouette(alpha, target.mask, area)
        else:
            weight = objective.interior(alpha)
            area = dr.maximum(dr.sum(weight), 1)
        wanted = target.rgb
        if (
            target.mask is None and s.blur > 0
            # both cut out alike, else a band inside the silhouette would compare with the
            # background
        ):
            inside = dr.gather(mi.Float, weight, dr.arange(mi.UInt32, 3 * self.pixels) // 3)
            rgb, wanted = (mi.TensorXf(x.array * inside, x.shape) for x in (rgb, wanted))
            wanted = objective.blur(wanted, s.blur)
        rgb = objective.blur(rgb, s.blur)
        if s.lighting == "local":
            rgb = objective.normalise_locally(
                rgb, self._weight_image(alpha if target.mask is not None else weight)
            )
            if target.mask is None:
                wanted = objective.normalise_locally(wanted, self._weight_image(weight))
        a, b = self._channels(rgb), self._channels(wanted)
        if s.lighting == "gain":
            g = objective.gain([dr.detach(x) for x in a], b, objective.interior(alpha))
            a = [g * x for x in a]
        terms["rgb"] = s.k_rgb * objective.photometric(
            a, b, weight, area, norm=s.rgb_norm, scale=s.rgb_scale
        )
        terms["inextensibility"] = s.k_mi * objective.inextensibility(
            vertices, self.edges, self.edge_lengths, self.patch.scale
        )
        if self.volume:
            now = objective.volume(vertices, self.volume.faces)
            terms["inextensibility"] += s.k_volume * dr.square(now / self.volume.rest - 1)
        return terms

    def _channels(self, tensor):
        index = dr.arange(mi.UInt32, self.pixels) * 3
        return [
            dr.gather(mi.Float, tensor.array, index + c, mode=dr.ReduceMode.Permute)
            for c in range(3)
        ]

    def temporal_term(self, window: list[Unknowns]) -> mi.Float:
        """The weighted temporal consistency of a list of Unknowns, a Float of 1, attached."""
        return self.settings.k_tc * objective.temporal(window)

    def evaluate(
        self, window: list[Unknowns], frames: list[int], *, backward: bool = False, seed: int = 0
    ) -> tuple[float, dict[str, float]]:
        """The objective over a window: (total, terms), numbers; with ``backward``, the gradients
        are added to the unknowns.

        ``window``: list of W Unknowns; ``frames``: their frames. Each frame's graph is traversed
        and freed before the next. Raises :class:`BadFrame` where a frame's part is not finite.
        """
        sums = dict.fromkeys(TERMS, 0.0)
        parts = []
        for k, (unknowns, frame) in enumerate(zip(window, frames)):
            terms = {
                name: value / len(window)
                for name, value in self.frame_terms(unknowns, frame, seed + 2 * k).items()
            }
            parts.append(self._finish(terms, backward))
            value = sum(x[0] for x in parts[-1].values())
            if not np.isfinite(value):
                raise BadFrame(frame, value)
        if len(window) > 1:
            parts.append(self._finish({"temporal": self.temporal_term(window)}, backward))
            if not np.isfinite(parts[-1]["temporal"][0]):
                raise BadFrame(frames[-1], parts[-1]["temporal"][0])
        for part in parts:
            for name, value in part.items():
                sums[name] += float(value[0])
        return sum(sums.values()), sums

    @staticmethod
    def _finish(terms, backward):
        loss = sum(terms.values())
        values = {name: dr.detach(value) for name, value in terms.items()}
        dr.schedule(values)
        if backward and dr.grad_enabled(loss):  # a weight of zero detaches
            dr.backward(loss)
        dr.eval()
        return values

    def check_start(self) -> None:
        """Raise InputError where the template, as the scene places it, cannot be seen in the first
        frame.
        """
        position, before = self.camera.project(self.template.vertices)
        where = f"{self.experiment.path}: the template"
        if not before.all():
            raise InputError(
                f"{where} has {int((~before).sum())} of {len(before)} vertices behind the camera;"
                " it must stand in its pose of the first frame"
            )
        low, high = position.min(0).round(), position.max(0).round()
        if self.visible_share(self.patch.rest()) == 0:
            raise InputError(
                f"{where} is out of view in the first frame: it projects to x"
                f" {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g} of an image of"
                f" {self.width}x{self.height} pixels"
            )
        mask = self.sequence.mask(0)
        if mask is not None:
            alpha = np.array(self.image(self.patch.vertices(self.patch.rest()))[1]).reshape(
                mask.shape
            )
            if float((alpha * mask).sum()) == 0:
                raise InputError(
                    f"{where} does not meet the mask of the first frame: it projects to x"
                    f" {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g}"
                )

        if not self._raster:
            if self.settings.solver != "adam":
                name = self.experiment.renderer.class_name()
                raise InputError(
                    f"{self.experiment.path}: solver {self.settings.solver} renders with raster,"
                    f" not with {name}; give solver=adam for that"
                )
            self._check_gradient()

    def _check_gradient(self):
        """Raise InputError where the integrator cannot be differentiated; Mitsuba tells only when
        it is.
        """
        unknowns = self.patch.rest()
        dr.enable_grad(unknowns)
        try:
            with interruptible():
                self.evaluate([unknowns], [0], backward=True, seed=self.settings.seed)
        except FloatingPointError:
            pass  # the image is to blame, which the tracker tells
        except RuntimeError as error:
            name, cause = self.experiment.renderer.class_name(), str(error).strip().splitlines()[0]
            raise InputError(
                f"{self.experiment.path}: integrator {name} gives no gradients; raster or"
                f" prb_projective is needed ({cause[:120]})"
            ) from None

    def visible_share(self, unknowns: Unknowns) -> float:
        """Share of the vertices that are before the camera and inside the image."""
        position, inside = self.camera.project(self.surface(unknowns))
        inside &= (position >= 0).all(1) & (position <= (self.width, self.height)).all(1)
        return float(inside.mean())

    def surface(self, unknowns: Unknowns) -> np.ndarray:
        """Vertices (N, 3) [m, camera frame] as float32 NumPy."""
        with dr.suspend_grad():
            return np.array(self.patch.vertices(unknowns)).T.astype(np.float32).copy()
