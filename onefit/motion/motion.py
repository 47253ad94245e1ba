"""Motions: poses and places of the root over time, read from files, generated, resampled."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from onefit.body import Body, skeleton
from polyfit.errors import InputError, as_number

from . import files, generate


@dataclass(frozen=True)
class Motion:
    """A sequence of poses of the 24 joints, in OneFit's world (metres, z up, facing -y).

    Both arrays are given as anything like one, and held as float32 tensors. ``poses`` (T, 24, 3)
    axis-angle vectors [rad], each joint relative to its parent and counted
    from the T-pose; ``translation`` (T, 3) [m], added to the rest position of the root joint;
    ``fps`` frames a second; ``name``. Raises InputError where shapes do not fit or a number is not
    finite.
    """

    poses: torch.Tensor
    translation: torch.Tensor
    fps: float
    name: str = "motion"

    def __post_init__(self):
        for what in ("poses", "translation"):
            object.__setattr__(self, what, self._tensor(what))
        T = len(self.poses) if self.poses.ndim else 0
        if (
            self.poses.ndim != 3
            or self.poses.shape[2] != 3
            or self.poses.shape[1] != len(skeleton.JOINTS)
        ):
            raise InputError(
                f"motion {self.name}: poses of shape {tuple(self.poses.shape)}; (frames,"
                f" {len(skeleton.JOINTS)}, 3) is needed"
            )
        if T == 0:
            raise InputError(f"motion {self.name}: no frames")
        if self.translation.shape != (T, 3):
            raise InputError(
                f"motion {self.name}: translation of shape {tuple(self.translation.shape)}; ({T},"
                " 3) is needed"
            )
        for what, values in (("poses", self.poses), ("translation", self.translation)):
            bad = ~torch.isfinite(values).flatten(1).all(1)
            if bad.any():
                where = (
                    f"{int(bad.sum())} of {T} frames, the first is frame {int(bad.nonzero()[0, 0])}"
                )
                raise InputError(
                    f"motion {self.name}: {what} are not finite in {where}; cut them out or fill"
                    " them in"
                )
        if not 0 < as_number(self.fps) < 10_000:
            raise InputError(
                f"motion {self.name}: {self.fps} frames a second; a positive number is needed"
            )

    def _tensor(self, what):
        """The attribute ``what`` as a float32 tensor."""
        values = getattr(self, what)
        try:
            if not isinstance(values, torch.Tensor):  # of lists of arrays NumPy makes one
                values = np.asarray(values, dtype=np.float32)
            return torch.as_tensor(values, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"motion {self.name}: {what} are no array of numbers") from None

    def __len__(self):
        return len(self.poses)

    def __getitem__(self, frames):
        """The motion of a slice of the frames."""
        return replace(self, poses=self.poses[frames], translation=self.translation[frames])

    def to(self, device: torch.device | str) -> Motion:
        """The same motion on ``device``."""
        return replace(self, poses=self.poses.to(device), translation=self.translation.to(device))

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], fps: float | None = None, up: str | None = None
    ) -> Motion:
        """A motion from a file: AMASS's ``.npz`` (``poses``, ``trans``, ``mocap_framerate``; z up),
        Neural Cloth Simulation's (``fps``; y up), or BVH.

        ``fps`` and ``up`` ("y" or "z") take the place of what the file says. SMPL's rotations are
        taken over joint by joint, in OneFit's axes (:mod:`onefit.motion.files`); a BVH skeleton is
        retargeted (:mod:`onefit.motion.bvh`). The motion starts at x = y = 0 with its lowest foot
        on the standard body's ground. Raises InputError for what cannot be used: not finite,
        another number of joints, no frame rate, another unit, a body that lies
        (:mod:`onefit.motion.likely`).
        """
        return cls(*files.read(path, fps, up))

    @classmethod
    def generate(cls, name: str, seconds: float = 10.0, seed: int = 0, fps: float = 30.0) -> Motion:
        """A generated motion of the kind ``name``, one of :data:`onefit.motion.generate.KINDS`; see
        :mod:`onefit.motion.generate`.
        """
        poses, translation = generate.generate(name, seconds, seed, fps)
        return cls(poses, translation, float(fps), f"{name}-{seed}")

    def fitted(self, body: Body) -> Motion:
        """The motion for a :class:`~onefit.Body` with longer or shorter legs than the standard
        body's: its way is scaled by their length, so that feet which stood still on the standard
        body nearly do on this one.
        """
        return replace(
            self,
            translation=self.translation
            * (skeleton.leg_length(body.joints) / skeleton.leg_length(skeleton.standard_joints())),
        )

    def led_in(self, body: Body, seconds: float) -> Motion:
        """The motion with ``seconds`` before it in which a :class:`~onefit.Body`, standing where
        the motion starts and turned as there, goes from its rest, in which garments are made, to
        the first pose.
        """
        count = round(seconds * self.fps)
        share = np.linspace(0, 1, count + 1)[:-1]
        share = share * share * (3 - 2 * share)
        pose = torch.cat([self.poses[0, :1], body.rest_pose[1:].to(self.poses)])
        rest, first = (
            Rotation.from_rotvec(x.detach().cpu().double().numpy()) for x in (pose, self.poses[0])
        )
        turn = (rest.inv() * first).as_rotvec()
        lead = [(rest * Rotation.from_rotvec(s * turn)).as_rotvec() for s in share]
        poses = torch.as_tensor(np.array(lead).reshape(-1, *self.poses.shape[1:])).to(self.poses)
        places = self.translation[:1].expand(count, -1)
        return replace(
            self,
            poses=torch.cat([poses, self.poses]),
            translation=torch.cat([places, self.translation]),
        )

    def mirrored(self) -> Motion:
        """The motion seen in a mirror: left is right, and x is -x."""
        poses, translation = skeleton.mirrored(self.poses, self.translation)
        return replace(self, poses=poses, translation=translation)

    def resampled(self, fps: float = 30.0) -> Motion:
        """The same motion at ``fps`` frames a second from the same start to (at most) the same end.

        Rotations go along great arcs (slerp) between the two frames beside each new one, places
        along straight lines. Where the old rate is a multiple of the new one, frames are taken as
        they are.
        """
        if not 0 < as_number(fps) < 10_000:
            raise InputError(f"{fps} frames a second; a positive number is needed")
        if fps == self.fps or len(self) == 1:
            return replace(self, fps=float(fps))
        count = int(np.floor((len(self) - 1) / self.fps * fps + 1e-6)) + 1
        at = np.arange(count) * (self.fps / fps)
        at = np.where(np.abs(at - np.round(at)) < 1e-6, np.round(at), at)
        first = np.minimum(at.astype(int), len(self) - 2)
        part = (at - first)[:, None]
        poses, places = (
            self.poses.detach().cpu().double().numpy(),
            self.translation.detach().cpu().double().numpy(),
        )
        before, after = (
            Rotation.from_rotvec(poses[first].reshape(-1, 3)),
            Rotation.from_rotvec(poses[first + 1].reshape(-1, 3)),
        )
        step = (before.inv() * after).as_rotvec() * np.repeat(part, poses.shape[1], 0)
        new = (before * Rotation.from_rotvec(step)).as_rotvec().reshape(count, -1, 3)
        place = places[first] * (1 - part) + places[first + 1] * part
        return replace(
            self,
            poses=torch.as_tensor(new).to(self.poses),
            translation=torch.as_tensor(place).to(self.translation),
            fps=float(fps),
        )
