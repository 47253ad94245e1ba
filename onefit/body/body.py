"""Bodies: a shape's rest surface with its joints and blend weights, and the models that make one
from shape parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from polyfit.errors import InputError

from . import skeleton
from .anny_data import read_fast


@dataclass(frozen=True)
class Body:
    """One shape of a body at rest: a closed surface, z up, facing -y, in the stand that
    ``rest_pose`` says.

    ``vertices`` (V, 3) [m]; ``faces`` (F, 3) int64, wound outwards; ``blend_weights`` (V, 24), rows
    that sum to one; ``joints`` (24, 3) [m]; ``rest_pose`` (24, 3) [rad], the pose that takes the
    T-pose to this stand; ``shape`` (S,), the parameters that made it; ``kind``, the model's name;
    ``parents``, those of :mod:`onefit.body.skeleton`.
    """

    vertices: torch.Tensor
    faces: torch.Tensor
    blend_weights: torch.Tensor
    joints: torch.Tensor
    rest_pose: torch.Tensor
    shape: torch.Tensor
    kind: str
    parents: tuple = skeleton.PARENTS

    def to(self, device: torch.device | str) -> Body:
        """The same body with its tensors on ``device``."""
        moved: dict[str, Any] = {
            f.name: v.to(device)
            for f in fields(self)
            if isinstance(v := getattr(self, f.name), torch.Tensor)
        }
        return replace(self, **moved)


class BodyModel:
    """What makes bodies: ``kind``, ``shape_names``, ``standard_shape`` (S,), :meth:`body`,
    :meth:`random_shape`.
    """

    kind: str
    shape_names: tuple
    standard_shape: torch.Tensor

    def body(self, shape: torch.Tensor | None = None) -> Body:
        """The :class:`Body` of ``shape`` (S,); None is the standard shape. Raises InputError for a
        shape that the model has not.
        """
        raise NotImplementedError

    def random_shape(self, rng: np.random.Generator) -> torch.Tensor:
        """A plausible shape (S,), drawn from a ``numpy.random.Generator``."""
        raise NotImplementedError

    def _shape(self, shape):
        """``shape`` checked, float32 (S,), on the CPU."""
        if shape is None:
            return self.standard_shape
        names = f"({len(self.shape_names)},) is needed: {', '.join(self.shape_names)}"
        try:
            shape = torch.as_tensor(shape, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError):
            kind = type(shape).__name__
            raise InputError(f"body {self.kind}: a shape of type {kind}; {names}") from None
        if shape.shape != self.standard_shape.shape:
            raise InputError(f"body {self.kind}: a shape of size {tuple(shape.shape)}; {names}")
        if not torch.isfinite(shape).all():
            raise InputError(f"body {self.kind}: a shape parameter is not finite")
        return shape


# Anny's bones that move with each joint, by the start of their names; left and right by the names'
# ends. A bone that no name here starts moves with its parent.
_BONES = {
    "root": "pelvis", "upperleg01": "hip", "lowerleg01": "knee", "foot": "ankle", "toe": "foot",
    "spine04": "spine1", "spine02": "spine2", "spine01": "spine3", "clavicle": "collar",
    "upperarm01": "shoulder", "lowerarm01": "elbow", "wrist": "wrist", "finger2": "hand",
    "finger3": "hand", "finger4": "hand", "finger5": "hand", "neck01": "neck", "head": "head",
}  # fmt: skip


class AnnyBody(BodyModel):
    """The body of the package ``anny`` (Apache 2.0, its data CC0), reduced to the 24 joints; needs
    no licence and no download.

    The shape is Anny's phenotype: gender (0 male, 1 female), age (child 1/3, young adult 2/3, old
    1), muscle, weight, height, proportions, each from 0 to 1; the standard shape has 0.5 everywhere
    (a teenager, 1.63 m). The surface is Anny's main component (13,348 vertices, closed: no eyes, no
    tongue), the rest stand its own A-pose. A joint lies at the first of the bones that move with it
    (hand and foot: in the middle of their fingers' and toes' first joints). A pose moves the body
    as Anny itself would with its bones turned in these groups.
    """

    kind = "anny"
    shape_names = ("gender", "age", "muscle", "weight", "height", "proportions")
    standard_shape = torch.full((6,), 0.5)

    def __init__(self) -> None:
        import anny

        # plain skinning: Anny's default compiles Warp kernels for seconds, and all skinning here is
        # onefit.body.skinning's
        with read_fast():
            model = self._anny = anny.Anny(skinning_method="lbs")
        bones, joint_of_bone = model.bone_labels, self.joint_of_bone()
        faces = model.get_triangular_faces()
        kept = largest_component(len(model.template_vertices), faces)
        number = torch.cumsum(kept, 0) - 1
        self._faces = number[faces[kept[faces].all(1)]]

        assigned = torch.zeros(len(bones), len(skeleton.JOINTS), dtype=torch.float64)
        assigned[torch.arange(len(bones)), joint_of_bone] = 1
        weights = model.dense_vertex_bone_weights[kept] @ assigned
        self._blend_weights = (weights / weights.sum(1, keepdim=True)).float()

        # joints from the heads of bones whose parents move with another joint
        parents = torch.tensor(model.bone_parents)
        first = (parents < 0) | (joint_of_bone[parents.clamp(min=0)] != joint_of_bone)
        place = (assigned * first[:, None]) / (assigned * first[:, None]).sum(0)
        self._joints = place.T @ model.template_bone_heads  # float64, (24, 3)
        self._joints_basis = place.T @ model.bone_heads_blendshapes  # (C, 24, 3)
        self._vertices = model.template_vertices[kept].float()
        self._vertices_basis = model.blendshapes[:, kept].float().flatten(1)  # (C, 3 V)

    def joint_of_bone(self) -> torch.Tensor:
        """The joint (104,) int64 that each of Anny's bones moves with."""
        of_bone: list[int] = []
        for label, parent in zip(self._anny.bone_labels, self._anny.bone_parents, strict=True):
            name, _, side = label.partition(".")
            joint = next((j for start, j in _BONES.items() if name.startswith(start)), None)
            if joint is None:
                of_bone.append(of_bone[parent])
            else:
                of_bone.append(skeleton.INDEX[{"L": "left_", "R": "right_", "": ""}[side] + joint])
        return torch.tensor(of_bone)

    def body(self, shape: torch.Tensor | None = None) -> Body:
        shape = self._shape(shape)
        if not ((shape >= 0) & (shape <= 1)).all():
            name, value = next(
                (n, v)
                for n, v in zip(self.shape_names, shape.tolist(), strict=True)
                if not 0 <= v <= 1
            )
            raise InputError(f"body anny: {name} = {value:g}; phenotypes go from 0 to 1")
        with torch.no_grad():
            values = dict(zip(self.shape_names, shape.double(), strict=True))
            coefficients = self._anny.get_phenotype_blendshape_coefficients(**values)[0]
            vertices = self._vertices + (coefficients.float() @ self._vertices_basis).unflatten(
                0, (-1, 3)
            )
            joints = self._joints + torch.tensordot(coefficients, self._joints_basis, 1)
            rest_pose = skeleton.rest_pose(joints).float()
        return Body(
            vertices, self._faces, self._blend_weights, joints.float(), rest_pose, shape, self.kind
        )

    # Ranges that random_shape draws from, uniformly: bodies from 1.4 to 1.95 m. Beyond them Anny
    # has children, giants and the very old.
    RANGES = {
        "gender": (0.0, 1.0), "age": (0.5, 0.8), "muscle": (0.3, 0.7), "weight": (0.25, 0.85),
        "height": (0.3, 0.55), "proportions": (0.25, 0.75),
    }  # fmt: skip

    def random_shape(self, rng: np.random.Generator) -> torch.Tensor:
        """A shape (6,) between teenager and middle age, uniform in :attr:`RANGES`, from a
        ``numpy.random.Generator``.
        """
        low, high = zip(*(self.RANGES[name] for name in self.shape_names), strict=True)
        return torch.from_numpy(rng.uniform(low, high)).float()


def largest_component(count, faces):
    """Whether each of ``count`` vertices is in the component of ``faces`` (F, 3) with the most
    vertices: (count,) bool.
    """
    import numpy as np

    from polyfit.mesh import components

    F = faces.numpy()
    of = components(count, np.concatenate([F[:, :2], F[:, 1:]]))
    return torch.from_numpy(of == np.bincount(of).argmax())
