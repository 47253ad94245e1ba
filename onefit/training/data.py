"""What a training draws from: windows of motions, bodies of many shapes, garments cut into patches
and graded to those shapes.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from onefit.body import AnnyBody, ClosestSurface, skinning
from onefit.garment import PatchedGarment
from onefit.motion import Motion, generate
from onefit.objective import objective
from onefit.physics import Material, Sheet

LENGTH = 10  # frames of a window that the body's encoder sees
# the same of lessons, how many of the last of them may be asked for, and how many are
LESSON_LENGTH, LESSON_LAST, LESSON_FRAMES = 45, 30, 4
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
    ``seeds`` - 1; ``shapes``: how many random bodies beside the standard one. ``patching``: how
    garments are cut, arguments of :class:`onefit.PatchedGarment`. ``lessons``: those of each
    garment, with their own motions and bodies; ``material`` of the cloth.
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
        patching=None,
        material="cotton",
        lessons=(),
        seed=0,
        advance=lambda: None,
    ):
        self.model, self.material = model or AnnyBody(), Material.named(material)
        rng = np.random.default_rng(seed)
        self.shapes = torch.stack(
            [self.model.standard_shape] + [self.model.random_shape(rng) for _ in range(shapes)]
        )
        self.lessons = lessons
        #: (G,): of each garment's lessons
        self.lesson_frames = torch.tensor([float(sum(len(x.poses) for x in g)) for g in lessons])
        if lessons:
            others = torch.stack([x.shape for found in lessons for x in found]).unique(dim=0)
            others = others[(others != self.shapes[0]).any(1)]
            self.shapes = torch.cat([self.shapes[:1], others])
        bodies = [self.model.body(shape) for shape in self.shapes]
        self.standard = bodies[0]
        self.vertices, self.joints, self.rest_poses = (
            torch.stack([getattr(b, name) for b in bodies])
            for name in ("vertices", "joints", "rest_pose")
        )
        if motions is None and not lessons:
            motions = [
                Motion.generate(name, seconds=seconds, seed=k)
                for name in generate.TRAINING
                for k in range(seeds)
            ]
        self.motions = [m.resampled(FPS) for m in motions or ()]
        self._windows = np.array(
            [
                (k, first)
                for k, m in enumerate(self.motions)
                for first in range(max(1, len(m.poses) - LENGTH + 1))
            ]
        )
        self.garments, self._sheets = [], {}
        for garment in garments:
            patched = PatchedGarment(garment, self.standard, **patching or {})
            rest = torch.stack([garment.graded(b) for b in bodies], 1)
            self.garments.append((patched, rest, patched.field @ rest))  # (N, S, 3) and (3 P, S, 3)
            advance()
        self.collider = ClosestSurface(self.standard.vertices, self.standard.faces)

    def __len__(self):
        """How many windows there are; of lessons, how many frames."""
        return int(self.lesson_frames.sum()) if self.lessons else len(self._windows)

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

    def lesson_windows(self, number, count, generator):
        """``count`` :class:`Windows` of LESSON_LENGTH frames, drawn from the lessons of the garment
        ``number``; which of their frames are asked for, (count, n), the same number of each; and
        the displacements (N, count n, 3) [m] of these.
        """
        draw = lambda most, size: torch.randint(most, (size,), generator=generator)
        lessons = [self.lessons[number][k] for k in draw(len(self.lessons[number]), count)]
        first = LESSON_LENGTH - LESSON_LAST
        asked = torch.stack([first + draw(LESSON_LAST, LESSON_FRAMES) for _ in lessons])
        parts = []
        for lesson, chosen in zip(lessons, asked):
            end = int(draw(len(lesson.poses) + LESSON_LAST - 1, 1))
            at = torch.arange(end - LESSON_LENGTH + 1, end + 1).clamp(0, len(lesson.poses) - 1)
            known = int((self.shapes == lesson.shape.to(self.shapes)).all(1).nonzero()[0, 0])
            wanted = lesson.displacement[:, at[chosen]].float()
            parts.append((lesson.poses[at], lesson.translation[at], torch.tensor(known), wanted))
        poses, translation, which, wanted = zip(*parts)
        device = self.vertices.device
        which = torch.stack(which).to(device)
        shape = self.shapes[which] - self.model.standard_shape.to(device)
        windows = Windows(
            torch.stack(poses).to(device), torch.stack(translation).to(device), shape, which
        )
        return windows, asked, torch.cat(wanted, 1)

    def scene(self, garment, poses, translation, number):
        """The :class:`onefit.objective.objective.Scene` of the garment of that index in frames of
        ``poses`` (T, J, 3) and ``translation`` (T, 3) [m], on bodies of the shapes ``number`` (T,).
        """
        _, rest, field = self.garments[garment]
        now = self.transforms(poses, translation, number)
        posed = skinning.skin(self.vertices[number], self.standard.blend_weights, now)
        return objective.Scene(now, posed, self.collider, rest[:, number], field[:, number])

    def transforms(self, poses, translation, number):
        """Those (T, J, 3, 4) of bodies of the shapes ``number`` (T,)."""
        body = replace(self.standard, joints=self.joints[number], rest_pose=self.rest_poses[number])
        return skinning.transforms(body, poses, translation)

    def sheets(self, garment, number):
        """``(sheet, frames)`` of the garment of that index for each of the shapes in ``number``
        (T,), and in which of the frames it is; each :class:`onefit.physics.sheet.Sheet` made once.
        """
        return [
            (self._sheet(garment, k), (number == k).nonzero()[:, 0])
            for k in number.unique().tolist()
        ]

    def _sheet(self, garment, shape):
        if (garment, shape) not in self._sheets:
            patched, rest, _ = self.garments[garment]
            cloth, rest = patched.garment, rest[:, shape]
            sides = None if cloth.cut is None else cloth.sides(rest).double().cpu().numpy()
            self._sheets[garment, shape] = Sheet(
                rest.double().cpu().numpy(), cloth.faces.cpu().numpy(), self.material, sides
            )
        return self._sheets[garment, shape]
