"""Further cameras that a person has as a calibrated rig, made into the folders that a scene
names.
"""

import glob
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.errors import InputError
from polysft_mi.scene import EXTENSIONS, read_rgb, written

from .camera import Lens, Undistortion
from .camera.rigs import read_rig
from .frames import read_frames
from .masked_frames import GivenMasks
from .output import FRAME, MASK, write_json, write_png

CAMERAS = "cameras"  # in the scene's folder
_VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
# how far the pose of a camera to another may change from frame to frame [rad, and of its distance]
_RIGID = 0.01


@dataclass
class _Camera:
    """``poses``: world to camera (4, 4), by the names of the images that tell them; ``source``,
    ``masks``: what its images are called, as the rig says it: a folder, a pattern, a video or an
    image; ``lens`` as of :class:`polysft_mi.capture.camera.rigs.View`.
    """

    lens: Callable[[int, int], Lens]
    poses: dict
    source: str
    masks: str | None


class GivenRig:
    """``path``: a rig as :func:`polysft_mi.capture.camera.rigs.read_rig` takes it; ``own``: what
    the scene's own camera is called in it (None for a folder of cameras of ours, which stand in
    the scene's world; then ``ours`` is True); ``scale``: metres of its unit; ``images``: the folder
    that its images' names count from, where it is not near the rig. Raises InputError.
    """

    def __init__(self, path, own=None, scale=1.0, images=None):
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"--rig-scale {scale:g}: metres a unit; above 0 is needed")
        rig = read_rig(path)
        self.path, self.ours = path, rig.ours
        self._scale, self._unit = scale, rig.unit
        self._places = [images] if images else rig.places
        self._cameras = self._by_camera(rig)
        names = ", ".join(self._cameras)
        if rig.ours:
            if own is not None or scale != 1:
                raise InputError(
                    f"{path}: its cameras stand in the scene's world, in metres; --camera-name and"
                    " --rig-scale are for other rigs"
                )
            self._name = None
            return
        if own not in self._cameras:
            raise InputError(
                f"{path}: {f'no camera {own} in it' if own else 'which took the frames?'};"
                f" --camera-name is one of {names}"
            )
        if len(self._cameras) < 2:
            raise InputError(f"{path}: {own} is the only camera; a rig has others")
        self._name = own

    def lens(self, width, height):
        """The :class:`polysft_mi.capture.camera.Lens` of the scene's own camera for frames of a
        size, None where the rig does not say it.
        """
        return self._cameras[self._name].lens(width, height) if self._name else None

    def write(self, folder, indices, view, scale=1.0, whole=False):
        """Write a folder for each further camera into ``folder``: the frames ``indices``,
        undistorted and scaled by ``scale``, masks where there are some, and ``camera.json``.

        ``view``: the :class:`polysft_mi.camera.Intrinsics` of the scene's own camera; ``whole``:
        whether these are all frames there are. Returns lines for a person. Raises InputError.
        """
        others = [name for name in self._cameras if name != self._name]
        for name in others:
            self._write_camera(os.path.join(folder, name), name, indices, scale, whole)
        return self._lines(others, view)

    def _write_camera(self, folder, name, indices, scale, whole):
        camera, pose = self._cameras[name], self._relative(name)
        source = self._found(camera.source)
        os.makedirs(os.path.join(folder, os.path.dirname(FRAME)))
        straight, count = None, 0
        for image in _frames(source, indices, whole):
            if straight is None:
                straight = Undistortion(camera.lens(*image.shape[1::-1]), scale)
            write_png(os.path.join(folder, FRAME.format(count)), straight.image(image))
            count += 1
        if count != len(indices):
            raise InputError(
                f"{source}: {count} frames for {len(indices)} of the scene's own camera; one for"
                " each, exposed with it, is needed"
            )
        if camera.masks:
            os.makedirs(os.path.join(folder, os.path.dirname(MASK)))
            GivenMasks(self._found(camera.masks)).write(folder, indices, straight)
        write_json(os.path.join(folder, "camera.json"), written(straight.camera, pose))

    def _lines(self, others, view):
        lines = [f"cameras: {', '.join(others)} of {self.path}"]
        if self._name is None:
            return lines
        undone = f", applied_scale undone ({self._unit:.4g})" if self._unit != 1 else ""
        lines[0] += f"; its unit is taken for {self._scale:g} m (--rig-scale){undone}"
        own = self.lens(view.width, view.height).camera
        if abs(own.fx / view.fx - 1) > 0.01:
            lines.append(
                f"note: {self.path}: {self._name} has a focal length of {own.fx:.1f} pixels there;"
                f" the scene's camera has {view.fx:.1f}"
            )
        return lines

    def _relative(self, name):
        """The pose (4, 4) [m] of a camera: from the frame of the scene's own to its own."""
        camera = self._cameras[name]
        if self._name is None:
            return next(iter(camera.poses.values()))
        own = self._cameras[self._name]
        pairs = [(camera.poses[k], own.poses[k]) for k in camera.poses if k in own.poses]
        if not pairs and len(camera.poses) == len(own.poses) == 1:
            pairs = [(*camera.poses.values(), *own.poses.values())]
        if not pairs:
            raise InputError(
                f"{self.path}: no image of {name} has the name of one of {self._name}; which were"
                " exposed together is not known"
            )
        found = np.stack([theirs @ np.linalg.inv(ours) for theirs, ours in pairs])
        pose, turns = found[0], Rotation.from_matrix(found[:, :3, :3])
        if len(found) > 1:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turns.mean().as_matrix(), found[:, :3, 3].mean(0)
            off = (turns * turns.mean().inv()).magnitude().max()
            moved = np.linalg.norm(found[:, :3, 3] - pose[:3, 3], axis=1).max()
            if off > _RIGID or moved > _RIGID * np.linalg.norm(pose[:3, 3]):
                raise InputError(
                    f"{self.path}: {name} and {self._name} move against each other; a rig of"
                    " cameras that stand still is needed"
                )
        pose = pose.copy()
        pose[:3, 3] *= self._scale * self._unit
        return pose

    def _by_camera(self, rig):
        """Name to :class:`_Camera` of a rig's views: images of one folder are one camera, called as
        that part of the folder's path which no other shares; where all images lie in one, each is a
        camera, called as the image without its ending.
        """
        views = [view for view in rig.views if self._is_image(view.name)]
        folder_of = lambda name: os.path.normpath(os.path.join(os.sep, os.path.dirname(name)))
        folders = {folder_of(view.name) for view in views}
        cameras = {}
        for view in rig.views:
            folder, file = os.path.split(os.path.normpath(view.name))
            stem, source, mask = os.path.splitext(file)[0], view.name, view.mask
            of_folder = rig.ours or glob.has_magic(file)
            if self._is_image(view.name) and len(folders) > 1:
                source, mask = folder, mask and os.path.dirname(mask)
                shared = os.path.commonpath(folders)
                name = os.path.relpath(folder_of(view.name), shared).split(os.sep)[0]
            else:
                name = os.path.basename(folder) if of_folder else stem
            camera = cameras.setdefault(name, _Camera(view.lens, {}, source, mask))
            if camera.source != source or stem in camera.poses:
                raise InputError(
                    f"{self.path}: two cameras are called {name}: {camera.source} and {source}"
                )
            camera.poses[stem] = view.world_to_camera
        return cameras

    def _is_image(self, name):
        """Whether a name of a rig is that of one image; instant-ngp leaves their endings out."""
        return (name.lower().endswith(EXTENSIONS) and not glob.has_magic(name)) or (
            not os.path.splitext(name)[1]
            and not any(os.path.isdir(os.path.join(place, name)) for place in self._places)
        )

    def _found(self, name):
        """The path of what a rig calls ``name``. An image stands for a folder or a video that is
        called as it is, but for its ending, where there is one.
        """
        for place in self._places:
            path = os.path.normpath(os.path.join(place, name))
            if glob.has_magic(name) or os.path.isdir(path):
                return path
            if self._is_image(name):
                stem = os.path.splitext(path)[0] if name.lower().endswith(EXTENSIONS) else path
                if os.path.isdir(stem):
                    return stem
                alike = sorted(glob.glob(f"{glob.escape(stem)}.*"))
                videos = [p for p in alike if p.lower().endswith(_VIDEOS)]
                images = [p for p in (path, *alike) if p.lower().endswith(EXTENSIONS)]
                path = next(iter([*videos, *filter(os.path.isfile, images)]), path)
            if os.path.isfile(path):
                return path
        raise InputError(
            f"{self.path}: {name}: neither there nor in {', '.join(self._places)}; --rig-images"
            " names the folder that it lies in"
        )


def _frames(source, indices, whole):
    """Yield the frames ``indices``, evenly apart, of a folder, a pattern, a video or an image,
    (H, W, 3) uint8 each; ``whole``: whether there are no others.
    """
    if source.lower().endswith(EXTENSIONS) and os.path.isfile(source):
        yield read_rgb(source)
        return
    stride = indices[1] - indices[0] if len(indices) > 1 else 1
    last = -1 if whole else indices[-1]
    for _, image in read_frames(source, indices[0], last, stride):
        yield image
