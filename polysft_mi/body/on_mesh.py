"""A garment is put on a body that is known as a moving mesh alone."""

from __future__ import annotations

import numpy as np

from polysft_mi.errors import InputError

from .bones import Bones
from .carrier import Carrier
from .motion import MeshMotion

_STEPS = 60.0  # of the cloth, a second
_FARTHEST = 0.15  # [m] of a template from the body that it lies on, in the mean
_SHOULDERS = 0.8  # of a body's height: what reaches as high hangs from them, and has no waistband


def on_mesh(
    vertices: np.ndarray, faces: np.ndarray, motion: MeshMotion
) -> tuple[Carrier, np.ndarray]:
    """The :class:`Carrier` of a template of ``vertices`` (N, 3) [m] and ``faces`` (F, 3), which
    lies on the mesh at rest, and the template as cloth on the moving mesh, (T, N, 3) [m, world].

    A mesh has no joints: small pieces of it carry the template, with weights as OneFit has them.
    The cloth is OneFit's simulation, which begins with what they carry, not with a network's drape.
    Of the known motion only the whole's place is corrected. Raises InputError for a template that
    does not lie on the mesh.
    """
    from onefit.body import ClosestSurface
    from onefit.garment import Binding, RenderMesh, inward, mended

    rest, surface = motion.rest, ClosestSurface(motion.rest, motion.faces)
    away = np.abs(surface(vertices, 1e9).distance).mean()
    if away > _FARTHEST:
        raise InputError(
            f"{motion.path}: the template is {away:.2f} m from this body at rest in the mean; it"
            " must lie on it, in the same world"
        )
    V, F, _ = mended(vertices, faces, "template", surface)
    F = np.where(inward(V, F, surface)[:, None], F[:, ::-1], F)
    seen = RenderMesh.bound(vertices, faces, None, V, F)
    bones = Bones.of(rest, motion.faces, motion.frames)
    on_cloth = Binding(V, F, surface).blend_weights(bones.weights)
    cloth = _simulated(V, F, on_cloth, bones, motion)
    weights = np.einsum("nk,nkj->nj", seen.barycentric, on_cloth[F[seen.face]])
    root = np.arange(len(bones.joints)) == 0
    carrier = bones.carrier(weights / weights.sum(1, keepdims=True), corrected=root, fps=motion.fps)
    skin = bones.carrier(bones.weights)
    back = [skin.maps(skin.at(k)).back(x) for k, x in enumerate(motion.frames)]
    carrier.skin = np.stack(back), bones.weights, motion.faces
    return carrier, np.stack([seen.carried(x, F) for x in cloth])


def _simulated(V, F, weights, bones, motion):
    """The cloth V (N, 3) [m], F (F, 3) in each frame of the motion, (T, N, 3) [m, world]."""
    import torch

    from onefit.draping import simulated
    from onefit.garment import held_below
    from onefit.physics import Material, Settings

    settings = Settings()
    led = bones.led_in(round(settings.lead * motion.fps))
    first = len(led.poses) - len(bones.poses)
    poses = range(len(led.poses))

    def carried(weights, points):
        by = led.carrier(weights)
        return np.stack([by.maps(by.at(k))(points) for k in poses])

    bodies = np.concatenate([carried(bones.weights, motion.rest)[:first], motion.frames])
    turn = lambda x: motion.upright.apply(x.reshape(-1, 3)).reshape(x.shape)
    at, height = turn(V), turn(motion.rest)[:, 2]
    shoulders = height.min() + _SHOULDERS * np.ptp(height)
    made = simulated(
        torch.as_tensor(turn(carried(weights, V))),
        torch.as_tensor(at).float(),
        torch.as_tensor(F),
        held_below(at, F, shoulders),
        torch.as_tensor(turn(bodies)).float(),
        torch.as_tensor(motion.faces),
        material=Material.named("cotton"),
        steps=int(np.ceil(_STEPS / motion.fps)),
        fps=motion.fps,
        settings=settings,
        first=first,
    )
    back = motion.upright.inv()
    return np.stack([back.apply(x.double().numpy()) for x in made])
