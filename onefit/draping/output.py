"""The files of a drape: arrays, animations, meshes, pictures, a video."""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from onefit.garment import parts
from polyfit.animation import write_frames, write_usd
from polyfit.errors import InputError
from polyfit.files import aside, folder_aside

BODY_COLOUR = (0.5, 0.48, 0.46)  # linear RGB
GARMENT_COLOURS = (0.08, 0.19, 0.42), (0.42, 0.12, 0.06), (0.10, 0.28, 0.13), (0.42, 0.30, 0.06)


@dataclass(frozen=True)
class Outcome:
    """What a drape took and how good it is. ``folder``: where it lies; ``frames``, ``vertices``:
    how many; ``seconds``: what it took in all, and what a simulation took of them before its first
    frame, ``settling``; ``figures``: its measures by name.
    """

    folder: Path
    frames: int
    vertices: int
    seconds: float
    settling: float
    figures: dict

    def as_text(self):
        """One fact a line."""
        settled = f", after {self.settling:.1f} s to settle" if self.settling else ""
        speed = 1e3 * (self.seconds - self.settling) / self.frames
        return (
            f"frames: {self.frames}, of {self.vertices} vertices\n"
            f"speed: {speed:.1f} ms a frame{settled}\n"
            f"inside the body: {self.figures['collision']:.2f} % of the vertices\n"
        )

    def next_step(self):
        """What to do with the result, in a line."""
        usd, video = self.folder / "garment.usd", self.folder / "drape.mp4"
        blender = f"import {usd} and body.usd in Blender"
        if video.exists():
            return f"open {video}" + (f", or {blender}" if usd.exists() else "")
        return blender if usd.exists() else f"read {self.folder / 'drape.npz'} by numpy.load"


def check_folder(folder, overwrite):
    """Raises InputError where ``folder`` holds something that a drape must not replace."""
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not overwrite:
            raise InputError(f"{folder}: not empty; give another -o, or --overwrite")
        if not (folder / "drape.npz").exists():
            raise InputError(f"{folder}: holds no drape; --overwrite replaces nothing else")


def drape_into(folder, make, verb, frames, *, about, **files):
    """Drape and write all files; returns the :class:`Outcome`.

    ``folder``: new, empty or holding a drape, which is replaced at the end. ``make``, a function of
    ``advance``: :meth:`onefit.Draper.drape` or :meth:`onefit.Draper.simulate`, as ``verb`` says, of
    all the rest; ``frames``: how many it makes. ``about``: names for figures.json; ``files``:
    options of :func:`write`. Progress goes to stderr.
    """
    folder, ends = Path(folder), [time.perf_counter()]
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(verb, total=frames)

        def advance():
            ends.append(time.perf_counter())
            progress.advance(task)

        drape = make(advance=advance)
        seconds = time.perf_counter() - ends[0]
    settling = ends[1] - ends[0] if verb == "simulate" else 0.0
    T, N = drape.vertices.shape[:2]
    outcome = Outcome(folder, T, N, seconds, settling, drape.measures().as_dict())
    about = dict(verb=verb, **about, vertices=N, frames=T, **outcome.figures)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        Progress(*columns, console=Console(stderr=True)) as progress,
        folder_aside(folder, lambda name: True) as temporary,
    ):
        visible = "render" not in files.get("skip", ())
        task = progress.add_task("rendering", total=T, visible=visible)
        write(drape, temporary, advance=lambda: progress.advance(task), **files)
        (Path(temporary) / "figures.json").write_text(
            json.dumps(about, indent=2) + "\n", encoding="utf-8"
        )
    return outcome


def _coloured(drape):
    """The garment as the stage takes it; of an outfit, each part in a colour of its own."""
    seen, faces = drape.render_vertices(), drape.faces.numpy()
    part = parts(faces)
    if drape.render_mesh is not None:
        part = part[drape.render_mesh.face]
        kept, faces = drape.render_mesh.welded(seen[0])
        seen, part = seen[:, kept], part[kept][faces[:, 0]]
    for k in np.unique(part):
        used, own = np.unique(faces[part == k], return_inverse=True)
        yield seen[:, used], own.reshape(-1, 3), GARMENT_COLOURS[k % len(GARMENT_COLOURS)]


def _render(drape, folder, size, spp, advance):
    """PNG frames and a video; Mitsuba is loaded here alone."""
    from polysft_mi.backend import set_variant

    set_variant()
    import cv2

    from polysft_mi.pictures import write_video
    from polysft_mi.render import stage

    meshes = [(drape.body.numpy(), drape.body_faces.numpy(), BODY_COLOUR), *_coloured(drape)]
    frames = folder / "frames"
    frames.mkdir()

    def pictures():
        for k, image in enumerate(stage.render(meshes, size=size, spp=spp)):
            cv2.imwrite(str(frames / f"{k:03d}.png"), image[..., ::-1])
            advance()
            yield image

    write_video(folder / "drape.mp4", pictures(), drape.fps)


def write(drape, folder, *, skip=(), meshes=None, size=(480, 360), spp=16, advance=lambda: None):
    """The files of a :class:`onefit.Drape` in the empty ``folder``; ``skip``: any of "usd",
    "render".
    """
    folder = Path(folder)
    arrays = {
        name: getattr(drape, name).numpy()
        for name in ("vertices", "faces", "rest", "body", "body_faces", "root")
    }
    seen, faces, texcoords = arrays["vertices"], arrays["faces"], None
    if drape.render_mesh is not None:
        seen = drape.render_vertices()
        faces, texcoords = drape.render_mesh.faces, drape.render_mesh.texcoords
        arrays |= {"mesh_vertices": seen.astype(np.float32), "mesh_faces": faces}
        if texcoords is not None:
            arrays |= {"uv": texcoords.coordinates, "uv_faces": texcoords.faces}
    with aside(folder / "drape.npz") as temporary:
        np.savez_compressed(temporary, fps=drape.fps, **arrays)
    if "usd" not in skip:
        write_usd(
            folder / "garment.usd",
            seen,
            faces,
            texcoords,
            fps=drape.fps,
            up="z",
            name="garment",
        )
        write_usd(
            folder / "body.usd",
            arrays["body"],
            arrays["body_faces"],
            fps=drape.fps,
            up="z",
            name="body",
        )
    if meshes:
        write_frames(folder / "meshes", meshes, seen, faces, texcoords, up="z")
    if "render" not in skip:
        _render(drape, folder, size, spp, advance)
