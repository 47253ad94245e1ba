"""What a training draws from: windows of motions, bodies of many shapes, garments cut into patches
and graded to those shapes.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from onefit.body import AnnyBody, ClosestSurface, skinning
from onefit.garment.charts import PatchedGarment
from onefit.motion import Motion, generate
from onefit.objective import objective

LENGTH = 10  # frames of a window that the body's encoder sees
FPS = 30.0


@dataclass(frozen=True)
class Windows:
    """B windows of L frames: ``poses`` (B, L, 24, 3), ``translation`` (B, L, 3) [m], ``shape`` (B,
    S) less the standard one, and ``number`` (B,), which of the shapes it is."""

    poses: torch.Tensor
    translation: torch.Tensor
    shape: torch.Tensor
    number: torch.Tensor


class TrainingData:
    """``garments``: names of templates or :class:`onefit.Garment`; ``motions``: those to
    draw from, by default every training kind of :mod:`onefit.motion.generate` with the seeds 0 ..
    ``seeds`` - 1; ``shapes``: how many random bodies beside the standard one.
    """

    def __init__(
        self,
        garments,
        *,
        model=None,
        motions=None,
        seeds=4,
        seconds=6.0,
        shapes=48,
        patches=None,
        order=4,
        seed=0,
        advance=lambda: None,
    ):
        self.model = model or AnnyBody()
        rng = np.random.default_rng(seed)
        self.shapes = torch.stack(
            [self.model.standard_shape] + [self.model.random_shape(rng) for _ in range(shapes)]
        )
        bodies = [self.model.body(shape) for shape in self.shapes]
        self.standard = bodies[0]
        self.vertices, self.joints, self.rest_poses = (
            torch.stack([getattr(b, name) for b in bodies])
            for name in ("vertices", "joints", "rest_pose")
        )
        if motions is None:
            motions = [
                Motion.generate(name, seconds=seconds, seed=k)
                for name in generate.TRAINING
                for k in range(seeds)
            ]
        self.motions = [m.resampled(FPS) for m in motions]
        frames = [max(1, len(m.poses) - LENGTH + 1) for m in self.motions]
        self._windows = np.stack(
            [
                np.repeat(np.arange(len(frames)), frames),
                np.concatenate([np.arange(f) for f in frames]),
            ],
            1,
        )
        self.garments = []
        for garment in garments:
            patched = PatchedGarment(garment, self.standard, patches=patches, order=order)
            rest = torch.stack([garment.graded(b) for b in bodies], 1)
            self.garments.append((patched, rest, patched.field @ rest))  # (N, S, 3) and (3 P, S, 3)
            advance()
        self.collider = ClosestSurface(self.standard.vertices, self.standard.faces)

    def __len__(self):
        """How many windows there are."""
        return len(self._windows)

    def to(self, device):
        for name in ("shapes", "vertices", "joints", "rest_poses"):
            setattr(self, name, getattr(self, name).to(device))
        self.standard = self.standard.to(device)
        self.garments = [tuple(x.to(device) for x in entry) for entry in self.garments]
        self.collider = ClosestSurface(self.standard.vertices, self.standard.faces)
        return self

    def windows(self, count, generator):
        """``count`` windows drawn at random, each with a shape of its own."""
        device = self.vertices.device
        chosen = self._windows[
            torch.randint(len(self._windows), (count,), generator=generator).numpy()
        ]
        number = torch.randint(len(self.shapes), (count,), generator=generator).to(device)
        poses, translation = [], []
        for k, start in chosen:
            at = np.minimum(np.arange(start, start + LENGTH), len(self.motions[k].poses) - 1)
            poses.append(self.motions[k].poses[at])
            translation.append(self.motions[k].translation[at])
        shape = self.shapes[number] - self.model.standard_shape.to(device)
        return Windows(
            torch.stack(poses).to(device), torch.stack(translation).to(device), shape, number
        )

    def lesson_windows(self, lessons, count, generator):
        """``count`` windows drawn from :class:`onefit.training.teacher.Lesson`, each with the
        body of its lesson, and the ``changes`` (K, A, count, 3) [m] of their last frames.
        """
        chosen = torch.randint(len(lessons), (count,), generator=generator).tolist()
        parts = []
        for lesson in (lessons[k] for k in chosen):
            end = int(torch.randint(len(lesson.poses), (1,), generator=generator))
            at = torch.arange(end - LENGTH + 1, end + 1).clamp(min=0)
            shape = lesson.shape - self.model.standard_shape
            parts.append(
                (lesson.poses[at], lesson.translation[at], shape, lesson.changes[:, :, end])
            )
        poses, translation, shape, changes = zip(*parts)
        device = self.vertices.device
        windows = Windows(
            *(torch.stack(x).to(device) for x in (poses, translation, shape)),
            torch.zeros(count, dtype=torch.long, device=device),
        )
        return windows, torch.stack(changes, 2)

    def scene(self, windows, rest, field):
        """The :class:`onefit.objective.objective.Scene` of the windows' last frames, and the
        transforms (B, J, 3, 4) one and two frames before; of a garment whose graded vertices are
        ``rest`` (N, S, 3), with the ``field`` (3 P, S, 3) of them.
        """
        number = windows.number
        body = replace(self.standard, joints=self.joints[number], rest_pose=self.rest_poses[number])
        now, *past = (
            skinning.transforms(body, windows.poses[:, -k], windows.translation[:, -k])
            for k in (1, 2, 3)
        )
        posed = skinning.skin(self.vertices[number], self.standard.blend_weights, now)
        return objective.Scene(now, posed, self.collider, rest[:, number], field[:, number]), past
