"""A garment's drapes, sampled over motions, become a :class:`onefit.baking.Baked` drape."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from onefit.body import ClosestSurface, skeleton, skinning
from onefit.draping import DRAG, PULL, Draper
from onefit.garment import Garment
from onefit.motion import Motion, generate

from .evaluation import Baked

_FPS = 30.0
_RIDGE = 1e-3  # of the answer, as a share of the mean square of what it is found from
_BLUR = 0.3  # of features, in units of their spread
_PLANE_STEP = 6  # every so many frames' skin is held against the cloth
_REACH = 0.04  # [m] from the skin, within which cloth is


@dataclass(frozen=True)
class Sampling:
    """How a drape is baked. ``seconds`` of each motion; ``taught``: seeds of each kind of motion in
    training whose drapes are the teacher's, with post-processing; ``guided``: seeds, these among
    them, of which the network alone says the guide; the motions of every second of the others are
    mixed (:func:`mixed`). ``shapes``: corrective shapes; ``guide``: its
    numbers; ``points``: pendulums; ``width``: of the network; ``steps``: of its training, and a
    sixth as many of all together. ``clearance`` [m]: how far cloth shall be from the skin, and
    ``skin``: what a vertex deeper than that costs, against one as far from the teacher.
    """

    seconds: float = 2.5
    taught: int = 3
    guided: int = 16
    shapes: int = 32
    guide: int = 24
    points: int = 48
    width: int = 128
    steps: int = 5000
    clearance: float = 0.005
    skin: float = 60.0


def bake(
    draper: Draper,
    garment: Garment | str | os.PathLike[str],
    shape: torch.Tensor | None = None,
    *,
    sampling: Sampling | None = None,
    advance: Callable[[str, float], object] = lambda stage, share: None,
) -> Baked:
    """The :class:`Baked` drape of ``garment`` (as :meth:`onefit.Draper.drape` takes it) on the body
    of ``shape`` (S,), in minutes. ``advance`` is told the stage and the share of it that is done.

    The teacher is :meth:`onefit.Draper.drape` on motions of all kinds of the training. Skinning
    weights are fitted to it, and it is turned back to the rest space by them. Guide and shapes are
    the principal components there of the network's drape and of the teacher's; the network learns
    the guide, least squares give the answer, and then mean, shapes and answer learn together
    not to be inside of the body.
    """
    s, garment = sampling or Sampling(), draper.garment(garment)
    torch.manual_seed(0)
    samples = _Samples(draper, garment, shape, s, advance)
    baked = samples.skinned()
    guides, teacher = samples.displacements(baked)
    mean, basis = _principal(torch.cat(guides), s.guide)
    goals = [(x - mean).flatten(1) @ basis for x in guides]
    hung = _spread(baked.mean, s.points)
    shaped = basis.T.reshape(s.guide, -1, 3)
    baked = replace(
        baked,
        hung=hung,
        points=baked.mean[hung] + mean.numpy()[hung],
        point_shapes=shaped[:, hung].numpy(),
        pull=samples.pull[hung],
    )
    features = [baked.features(*_arrays(m))[0] for m in samples.motions]
    for motion, guide in samples.guided(baked):
        features.append(baked.features(*_arrays(motion))[0])
        goals.append((guide - mean).flatten(1) @ basis)
    new = len(generate.TRAINING)  # motions at the end, of which the network does not learn
    baked = _network(baked, np.concatenate(features[:-new]), torch.cat(goals[:-new]), s, advance)
    wrong = baked.guide(np.concatenate(features[-new:])) - torch.cat(goals[-new:]).numpy()

    offset, basis = _principal(teacher, s.shapes)
    weights = (teacher - offset).flatten(1) @ basis
    unit = weights.std(0)
    known = torch.from_numpy(np.concatenate([_known(baked, m) for m in samples.motions]))
    centre = known.mean(0)
    square = (known - centre).T @ (known - centre)
    square += _RIDGE * square.diagonal().mean() * torch.eye(len(square))
    answer = torch.linalg.solve(square, (known - centre).T @ (weights / unit))
    shapes = (basis * unit).T.reshape(s.shapes, -1, 3)
    offset = offset - ((centre @ answer) @ shapes.flatten(1)).reshape(-1, 3)
    wrong = torch.nn.functional.pad(torch.from_numpy(wrong), (0, known.shape[1] - s.guide))
    return _clear(baked, samples, known, wrong, teacher, offset, shapes, answer, s, advance)


class _Samples:
    """The teacher's drapes: ``motions``, their drapes and those of the network alone, (T, N, 3)
    [m], and of some ``frames`` of all of them the ``planes`` of the skin, as world normals (n, N,
    3) and heights (n, N), NaN where it is far.
    """

    def __init__(self, draper, garment, shape, s, advance):
        self._draper, self._garment, self._shape = draper, garment, shape
        self._s, self._advance = s, advance
        self.body = draper.model.body(shape)
        self.rest = garment.graded(self.body)
        self.pull = draper.pull(garment)
        self.motions, self.drapes, self.alone, normals, heights = [], [], [], [], []
        kinds = [(k, n) for n in range(s.taught) for k in generate.TRAINING]
        surface = None
        for k, (kind, seed) in enumerate(kinds):
            motion, alone = self._alone(kind, seed)
            drape = draper.drape(garment, motion, shape)
            surface = surface or ClosestSurface(drape.body[0], drape.body_faces)
            for x, body in zip(drape.vertices[::_PLANE_STEP], drape.body[::_PLANE_STEP]):
                surface.follow(body)
                near = surface(x, _REACH)
                normals.append(near.normal)
                heights.append((near.normal * near.point).sum(-1))
            self.motions.append(motion)
            self.drapes.append(drape.vertices)
            self.alone.append(alone)
            advance("draping", (k + 1) / len(kinds))
        lengths = np.cumsum([0] + [len(m) for m in self.motions])
        self.frames = np.concatenate([np.arange(a, b, _PLANE_STEP) for a, b in pairwise(lengths)])
        self.planes = torch.stack(normals), torch.stack(heights)

    def _alone(self, kind, seed, mix=False):
        make = mixed if mix else Motion.generate
        motion = make(kind, seconds=self._s.seconds, seed=seed, fps=_FPS)
        drape = self._draper.drape(self._garment, motion, self._shape, post=False)
        return motion, drape.vertices

    def skinned(self):
        """A :class:`Baked` of the skeleton and of skinning weights and a mean fitted to the
        drapes, without anything that changes them.
        """
        body, parents = self.body, list(skeleton.PARENTS)
        used = (self._garment.blend_weights > 0.01).any(0).nonzero()[:, 0].tolist()
        seen = {*used, *(j for j, p in enumerate(parents) if p in used)}
        for j in [*seen]:
            while (j := parents[j]) >= 0:
                seen.add(j)
        maps, poses = [], []
        for motion, drape in zip(self.motions, self.drapes):
            maps.append(self.transforms(motion)[::24])
            poses.append(drape[::24])
        weights, mean = _fitted(
            torch.cat(poses), torch.cat(maps)[:, used], self.rest,
            self._garment.blend_weights[:, used], torch.from_numpy(self.pull),
        )  # fmt: skip
        largest = weights.topk(min(4, len(used)), 1)
        pad = lambda x: torch.nn.functional.pad(x, (0, 4 - x.shape[1]))
        pace = float(self._fitted(self.motions[0]).translation.norm())
        pace /= max(float(self.motions[0].translation.norm()), 1e-9)
        empty = np.zeros(0, np.float32)
        return Baked(
            name=self._garment.name, fps=_FPS, faces=self._garment.faces.numpy(),
            mean=mean.numpy(), shapes=empty,
            joint_of=pad(torch.tensor(used)[largest.indices]).numpy(),
            joint_weights=pad(largest.values).numpy(),
            joints=body.joints.numpy(), parents=np.array(parents),
            rest_rotations=skeleton.chained_rotations(body.rest_pose).numpy(),
            pace=pace, seen=np.array(sorted(seen)),
            layers=(), biases=(), hung=empty, points=empty, point_shapes=empty, pull=empty,
            drag=DRAG, answer=empty,
        )  # fmt: skip

    def _fitted(self, motion):
        return motion if self._shape is None else motion.fitted(self.body)

    def transforms(self, motion):
        motion = self._fitted(motion)
        return skinning.transforms(self.body, motion.poses, motion.translation)

    def displacements(self, baked):
        """In the rest space of ``baked``, from its mean: of the network alone, a list of (T, N, 3),
        and of all the teacher's frames.
        """
        guides, teacher = [], []
        for k, motion in enumerate(self.motions):
            maps = self.blended(baked, motion)
            guides.append(_unposed(self.alone[k], maps, baked.mean))
            teacher.append(_unposed(self.drapes[k], maps, baked.mean))
        self.alone = self.drapes = ()
        return guides, torch.cat(teacher)

    def blended(self, baked, motion):
        """Maps (T, N, 3, 4) of the vertices by the weights of ``baked``."""
        dense = torch.zeros(len(baked.mean), len(baked.parents))
        joints, weights = (torch.from_numpy(x) for x in (baked.joint_of, baked.joint_weights))
        return skinning.blended(dense.scatter_add(1, joints, weights), self.transforms(motion))

    def guided(self, baked):
        """Yield (motion, displacements (T, N, 3) of the network alone) of the other seeds."""
        s = self._s
        kinds = [(k, n) for n in range(s.taught, s.guided) for k in generate.TRAINING]
        for k, (kind, seed) in enumerate(kinds):
            motion, alone = self._alone(kind, seed, mix=seed % 2 == 1)
            yield motion, _unposed(alone, self.blended(baked, motion), baked.mean)
            self._advance("guides", (k + 1) / len(kinds))


def mixed(kind: str, seconds: float, seed: int, fps: float) -> Motion:
    """A :class:`onefit.Motion` with root and legs of a generated motion of ``kind`` and the rest of
    one of another kind in training; rotations made larger or smaller, joints and root tilted a
    little. No one moves so, but it shows what each joint does by itself.
    """
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    one = Motion.generate(kind, seconds, seed, fps)
    two = Motion.generate(str(rng.choice(generate.TRAINING)), seconds, seed, fps)
    legs = ("pelvis", "hip", "knee", "ankle", "foot")
    upper = [j for j, name in enumerate(skeleton.JOINTS) if not name.endswith(legs)]
    poses = one.poses.clone()
    poses[:, upper] = two.poses[:, upper]
    factor, tilt = rng.uniform(0.7, 1.3, (24, 1)), rng.normal(0, 0.12, (24, 3))
    poses[:, 1:] = (poses * torch.tensor(factor) + torch.tensor(tilt)).float()[:, 1:]
    leaning = Rotation.from_rotvec([*rng.normal(0, 0.2, 2), 0.0])
    root = Rotation.from_rotvec(poses[:, 0].numpy()) * leaning
    poses[:, 0] = torch.tensor(root.as_rotvec()).float()
    return replace(one, poses=poses)


def _arrays(motion):
    return motion.poses.numpy(), motion.translation.numpy()


def _known(baked, motion):
    """Guide and swings (T, G + 3 P) of a motion."""
    features, placed = baked.features(*_arrays(motion))
    guide, swung = baked.guide(features), baked.swings()
    swings = [swung(m, g) for m, g in zip(baked.maps(placed), guide)]
    return np.concatenate([guide, np.stack(swings)], 1)


def _fitted(vertices, maps, rest, weights, pull, rounds=3, steps=150):
    """Skinning weights (N, J), four a vertex at most, and places at rest (N, 3) [m], that bring
    joints with maps (T, J, 3, 4) nearest to vertices (T, N, 3) [m], from ``rest`` and ``weights``:
    by turns least squares for the places, and projected gradients (accelerated as Nesterov does)
    for the weights, which stay the nearer to the first the more skin holds them: ``pull`` (N,).
    """
    first, spring = weights, (4e-4 / PULL * pull.clamp(max=1e5))[:, None]  # [m^2]
    for k in range(rounds):
        moved = torch.einsum("tjab,nb->njta", maps[..., :3], rest) + maps[:, :, :, 3].transpose(
            0, 1
        )
        moved = moved.flatten(2)
        goal = vertices.transpose(0, 1).flatten(1)
        square = moved @ moved.mT / len(maps)
        square += spring[..., None] * torch.eye(maps.shape[1])
        right = (moved @ goal[..., None])[..., 0] / len(maps) + spring * first
        step = 1 / torch.linalg.matrix_norm(square, 2)[:, None]
        ahead, pace = weights, 1.0
        for _ in range(steps):
            new = _on_simplex(ahead - step * ((square @ ahead[..., None])[..., 0] - right))
            after = (1 + (1 + 4 * pace * pace) ** 0.5) / 2
            ahead, weights, pace = new + (pace - 1) / after * (new - weights), new, after
        if k == rounds - 1:
            few = weights.topk(min(4, weights.shape[1]), 1)
            weights = torch.zeros_like(weights).scatter(1, few.indices, few.values)
            weights = weights / weights.sum(1, keepdim=True)
        blended = skinning.blended(weights, maps)
        turn = blended[..., :3]
        left = vertices - (turn @ rest[..., None])[..., 0] - blended[..., 3]
        square = (turn.mT @ turn).mean(0) + 0.01 * torch.eye(3)
        rest = rest + torch.linalg.solve(square, (turn.mT @ left[..., None]).mean(0))[..., 0]
    return weights, rest


def _on_simplex(x):
    """The points nearest to those of ``x`` (N, J) that are not negative and sum to one (Held,
    Wolfe and Crowder 1974).
    """
    ordered = x.sort(1, descending=True).values
    over = (ordered.cumsum(1) - 1) / torch.arange(1, x.shape[1] + 1)
    last = (ordered > over).sum(1, keepdim=True) - 1
    return (x - over.gather(1, last)).clamp(min=0)


def _unposed(vertices, maps, mean):
    """Displacements (T, N, 3) [m] in the rest space from ``mean`` (N, 3), of vertices (T, N, 3) [m]
    under maps (T, N, 3, 4). Where a map nearly folds space, less than exact.
    """
    turn = maps[..., :3]
    away = vertices - (turn @ torch.from_numpy(mean)[..., None])[..., 0] - maps[..., 3]
    a, b, c = turn.unbind(-1)
    rows = [torch.linalg.cross(p, q) for p, q in ((b, c), (c, a), (a, b))]
    volume = (rows[0] * a).sum(-1).clamp(min=0.2)
    return torch.stack([(r * away).sum(-1) for r in rows], -1) / volume[..., None]


def _principal(x, count):
    """The mean (N, 3) and the first principal components (3 N, count) of x (T, N, 3)."""
    mean = x.mean(0)
    step = max(1, len(x) // 1500)
    return mean, torch.svd_lowrank((x[::step] - mean).flatten(1), count + 12, niter=2)[2][:, :count]


def _spread(points, count):
    """Numbers (count,) of points (N, 3) that lie far from each other, from the lowest on."""
    chosen, far = [int(points[:, 2].argmin())], np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        far = np.minimum(far, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(far.argmax()))
    return np.array(chosen)


def _network(baked, features, goals, s, advance):
    """``baked`` with the network that finds ``goals`` (T, G) from ``features`` (T, C), which are
    blurred, for the network shall not know single motions by heart.
    """
    x = torch.from_numpy(features)
    mean, scale, unit = x.mean(0), x.std(0).clamp(min=1e-2), goals.std()
    x, goals = (x - mean) / scale, goals / unit
    sizes = [x.shape[1], s.width, s.width, goals.shape[1]]
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    relu = torch.nn.ReLU()
    network = torch.nn.Sequential(linear[0], relu, linear[1], relu, linear[2])
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=0.3)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=s.steps)
    for k in range(s.steps):
        some = torch.randint(len(x), (512,))
        blurred = x[some] + _BLUR * torch.randn(len(some), x.shape[1])
        loss = (network(blurred) - goals[some]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        rate.step()
        advance("network", (k + 1) / s.steps)
    with torch.no_grad():
        layers = [x.weight.T.clone() for x in linear]
        biases = [x.bias.clone() for x in linear]
        layers[0] /= scale[:, None]
        biases[0] -= mean @ layers[0]
        layers[-1], biases[-1] = layers[-1] * unit, biases[-1] * unit
    as_arrays = lambda some: tuple(np.ascontiguousarray(x.numpy()) for x in some)
    return replace(baked, layers=as_arrays(layers), biases=as_arrays(biases))


def _clear(baked, samples, known, wrong, teacher, offset, shapes, answer, s, advance):
    """``baked`` with the ``offset`` (N, 3) of its mean, ``shapes`` (R, N, 3) and ``answer``, after
    they learned together to be near to the ``teacher`` (T, N, 3), from what is ``known`` (T, G + 3
    P), and outside of the body also where that is ``wrong`` by (W, G + 3 P), as in motions that the
    network does not know.
    """
    mean = torch.from_numpy(baked.mean)
    blended = torch.cat([samples.blended(baked, m)[::_PLANE_STEP] for m in samples.motions])
    normal, height = samples.planes
    # a plane of the skin, as a displacement in the rest space sees it: height above = a . d + b
    a = (blended[..., :3].mT @ normal[..., None])[..., 0]
    at = (blended[..., :3] @ mean[..., None])[..., 0] + blended[..., 3]
    b = (normal * at).sum(-1) - height
    far = ~torch.isfinite(b)
    a, b = a.masked_fill(far[..., None], 0), b.masked_fill(far, 1.0)
    del blended, at, normal, height
    frames = torch.from_numpy(samples.frames)
    known, goals = known[frames], teacher[frames]
    learned = [torch.nn.Parameter(x.clone()) for x in (offset, shapes.flatten(1), answer)]
    rates = 2e-4, 2e-5, float(answer.abs().mean()) * 0.02
    optimiser = torch.optim.Adam([dict(params=[p], lr=r) for p, r in zip(learned, rates)])
    steps = s.steps // 6
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, list(rates), total_steps=steps)
    for k in range(steps):
        some = torch.randint(len(frames), (24,))
        d = (known[some] @ learned[2] @ learned[1]).unflatten(1, (-1, 3)) + learned[0]
        errors = 1.5 * wrong[torch.randint(len(wrong), (len(some),))]
        off = d + (errors @ learned[2] @ learned[1]).unflatten(1, (-1, 3))
        deep = (s.clearance - (a[some] * off).sum(-1) - b[some]).clamp(min=0)
        loss = (d - goals[some]).square().sum(-1).mean() + s.skin * deep.square().mean()
        optimiser.zero_grad()
        (1e4 * loss).backward()
        optimiser.step()
        rate.step()
        advance("skin", (k + 1) / steps)
    offset, shapes, answer = (p.detach() for p in learned)
    return replace(
        baked,
        mean=(mean + offset).numpy(),
        shapes=shapes.unflatten(1, (-1, 3)).numpy(),
        answer=answer.numpy(),
    )
