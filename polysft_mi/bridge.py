"""Where torch and Dr.Jit meet: PolyFit sets up the Dr.Jit template, and gradients cross both ways
(``dr.wrap``).

    torch   points -> PolyFit -> alpha, O -> vertices -> loss
                                                  \\-> :func:`rendering` -> image -> loss
    Dr.Jit  alpha -> surface -> image -> loss
                 \\-> :func:`in_torch` -> any torch function -> loss

By :func:`rendering` a loss of an image reaches PolyFit's network; by :func:`in_torch` a loss in
torch reaches the alpha of Dr.Jit.

Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from polyfit import jets
from polyfit.errors import InputError
from polyfit.mesh import TexCoords, as_arrays

from .surface import Template, Unknowns

if TYPE_CHECKING:
    from polyfit.network import PolyFit

    from .objective import Problem
    from .surface import JetAtlas


def template(
    polyfit: PolyFit,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | TexCoords,
    **options: Any,
) -> Template:
    """The :class:`polysft_mi.surface.template.Template` of the mesh in the frame, and of the order,
    of ``polyfit`` (:class:`polyfit.PolyFit`).

    ``vertices`` (N, 3) [m], ``faces`` (F, 3), ``uv`` (N, 2) or :class:`polyfit.mesh.TexCoords`;
    ``options`` are those of ``Template.fit``. Raises InputError as that does, and for arrays of
    other shapes.
    """
    vertices, faces = as_arrays(vertices, faces, "template")
    if not isinstance(uv, TexCoords) and np.shape(uv) != (len(vertices), 2):
        raise InputError(f"template: uv of shape {np.shape(uv)}; ({len(vertices)}, 2) is needed")
    frame = polyfit.frame_of(vertices)
    return Template.fit(vertices, faces, uv, polyfit.order, frame=frame, **options)


def surface(polyfit: PolyFit, points: torch.Tensor) -> torch.Tensor:
    """The points (K, P, 3) [m] of patches, put onto the patches' jets along the frames' z;
    differentiable to the weights of ``polyfit``."""
    found = polyfit(points)
    chart = found.frame.to_chart(points)
    return found.frame.from_chart(jets.point(found.jet.alpha, chart[..., :2]))


def _in_drjit(function: Callable) -> Callable:
    """A Dr.Jit ``function`` as a torch function: of tensors, on tensors, torch's autograd runs
    through it.
    """
    return dr.wrap(source="torch", target="drjit")(function)


def in_torch(function: Callable) -> Callable:
    """A torch ``function`` as a Dr.Jit function: of Dr.Jit tensors and arrays, Dr.Jit's AD runs
    through it.
    """
    return dr.wrap(source="drjit", target="torch")(function)


def rendering(
    problem: Problem, seed: int = 0
) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """The rendering of a :class:`polysft_mi.objective.problem.Problem` as a torch function:
    vertices (N, 3) [m, camera frame] -> (rgb (H, W, 3) linear, alpha (H, W)). It raises InputError
    for anything else."""
    count = len(problem.template.vertices)

    @_in_drjit
    def render(vertices: mi.TensorXf) -> tuple[mi.TensorXf, mi.TensorXf]:
        rgb, alpha = problem.placed.image(_points(vertices.array), seed, problem.settings.spp)
        return rgb, mi.TensorXf(alpha.array, (problem.height, problem.width))

    def of(vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rgb, alpha = render(_at_home("vertices", vertices, count, 3))
        return rgb.to(vertices.device), alpha.to(vertices.device)

    return of


def deformed(patch: JetAtlas) -> Callable[..., torch.Tensor]:
    """The surface of a :class:`polysft_mi.surface.patch.JetAtlas` as a torch function of the
    unknowns: delta_alpha (A,), delta_u, delta_v, delta_w (N,), rotation (4,), translation (3,) ->
    vertices (N, 3) [m, camera frame]; of K patches K times as many of all but delta_u, delta_v and
    delta_w, patch by patch. It raises InputError for anything else."""
    sizes = {name: dr.width(x) for name, x in patch.rest().items() if name != "pose"}

    @_in_drjit
    def vertices(*unknowns: mi.TensorXf) -> mi.TensorXf:
        points = patch.vertices(Unknowns(*(x.array for x in unknowns)))
        return mi.TensorXf(dr.ravel(points), (dr.width(points), 3))  # type: ignore[call-overload]

    def of(*unknowns: torch.Tensor) -> torch.Tensor:
        if len(unknowns) != len(sizes):
            raise InputError(f"{len(unknowns)} unknowns; {', '.join(sizes)} are needed")
        there = [_at_home(name, x, size) for (name, size), x in zip(sizes.items(), unknowns)]
        return vertices(*there).to(unknowns[0].device)

    return of


def _at_home(name: str, tensor: torch.Tensor, *shape: int) -> torch.Tensor:
    """A tensor of this ``shape`` in single precision where the variant in force computes. Raises
    InputError for anything else; Mitsuba would read past the end of what is too short.
    """
    if not isinstance(tensor, torch.Tensor) or tensor.shape != shape:
        given = f"{type(tensor).__name__} of shape {tuple(np.shape(tensor))}"
        raise InputError(f"{name}: {given}; a tensor of torch of shape {shape} is needed")
    device = "cuda" if str(mi.variant()).startswith("cuda") else "cpu"
    return tensor.to(device, torch.float32).contiguous()


def _points(flat: mi.Float) -> mi.Point3f:
    """(3 N,) as a Point3f of N."""
    index = 3 * dr.arange(mi.UInt32, dr.width(flat) // 3)
    return mi.Point3f(*(dr.gather(mi.Float, flat, index + k) for k in range(3)))
