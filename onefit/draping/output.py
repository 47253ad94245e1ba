"""The files of a drape: arrays, animations, meshes, pictures, a video."""

import re
import time
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from onefit.garment import parts
from onefit.objective import depths_beneath
from polyfit.animation import write_frames, write_usd
from polyfit.backend import set_variant
from polyfit.files import aside, check_aside, folder_aside, json_text
from polyfit.pictures import write_video

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
        ) + "".join(
            f"{name} beneath those under it: {found['beneath']:.2f} % of the vertices\n"
            for name, found in self.figures.get("garments", {}).items()
            if "beneath" in found
        )

    def next_step(self):
        """What to do with the result, in a line."""
        arrays = _arrays(self.folder)[0]
        usd, video = arrays.with_name("garment.usd"), self.folder / "drape.mp4"
        blender = f"import {usd} and body.usd in Blender"
        if video.exists():
            return f"open {video}" + (f", or {blender}" if usd.exists() else "")
        return blender if usd.exists() else f"read {arrays} by numpy.load"


# What a drape writes into its folder, and each garment of several into its own
_OURS = re.compile(
    r"figures\.json|drape\.mp4|frames/\d+\.png"
    r"|(\d+_[^/]+/)?(drape\.npz|(garment|body)\.usd|meshes/(\d+\.(obj|ply)|surface\.mtl|frames\.json))"
)


def _is_ours(path):
    return bool(_OURS.fullmatch(path))


def check_folder(folder, overwrite):
    """Raises InputError where a drape cannot be written to ``folder``, or something is there that
    it must not replace.
    """
    check_aside(folder, _is_ours, _sign(folder), "drape", overwrite)


def _sign(folder):
    """A pattern of the file that tells a drape's ``folder``, or one of several garments."""
    return "drape.npz" if (Path(folder) / "drape.npz").exists() else "*/drape.npz"


def _arrays(folder):
    """The drape.npz of a folder: its own, or those of the garments of an outfit."""
    return [*folder.glob("drape.npz"), *sorted(folder.glob("*/drape.npz"))]


def _folders(names):
    """The folders of garments by their ``names``, in their order: none of one alone."""
    if len(names) == 1:
        return [""]
    return [f"{k + 1}_{Path(name).stem}" for k, name in enumerate(names)]


def drape_into(folder, make, verb, frames, *, names, about, **files):
    """Drape and write all files; returns the :class:`Outcome`.

    ``folder``: new, empty or holding a drape, which is replaced at the end. ``make``, a function of
    ``advance``: :meth:`onefit.Draper.drape` or :meth:`onefit.Draper.simulate`, as ``verb`` says, of
    a list of garments and all the rest; ``names``: what these are called; ``frames``: how many it
    makes. ``about``: names for figures.json; ``files``: options of :func:`write`. Progress goes to
    stderr.
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

        drapes = make(advance=advance)
        seconds = time.perf_counter() - ends[0]
    settling = ends[1] - ends[0] if verb == "simulate" else 0.0
    T, counts = len(drapes[0].vertices), [drape.vertices.shape[1] for drape in drapes]
    found, N = [drape.measures().as_dict() for drape in drapes], sum(counts)
    figures = found[0]
    if len(drapes) > 1:
        inside = float(np.average([f["collision"] for f in found], weights=counts))
        each = [dict(vertices=n, **f) for n, f in zip(counts, found)]
        for k in range(1, len(drapes)):
            each[k]["beneath"] = _beneath(drapes[k], drapes[:k])
        figures = dict(collision=inside, garments=dict(zip(_folders(names), each)))
    outcome = Outcome(folder, T, N, seconds, settling, figures)
    about = dict(verb=verb, **about, vertices=N, frames=T, **figures)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        Progress(*columns, console=Console(stderr=True)) as progress,
        folder_aside(folder, _is_ours, _sign(folder)) as temporary,
    ):
        visible = "render" not in files.get("skip", ())
        task = progress.add_task("rendering", total=T, visible=visible)
        write(drapes, names, temporary, advance=lambda: progress.advance(task), **files)
        (Path(temporary) / "figures.json").write_text(
            json_text(about, indent=2) + "\n", encoding="utf-8"
        )
    return outcome


def _beneath(outer, inner):
    """% of the vertices of a drape, in all its frames, that lie beneath any ``inner`` one."""
    depths = [depths_beneath(outer.vertices, one.vertices, one.faces) for one in inner]
    return 100 * float((np.stack(depths) > 0).any(0).mean())


def _coloured(drapes):
    """The garments as the stage takes them; each part of each in a colour of its own."""
    colours = cycle(GARMENT_COLOURS)
    for drape in drapes:
        seen, faces = drape.render_vertices(), drape.faces.numpy()
        part = parts(faces)
        if drape.render_mesh is not None:
            part = part[drape.render_mesh.face]
            kept, faces = drape.render_mesh.welded(seen[0])
            seen, part = seen[:, kept], part[kept][faces[:, 0]]
        for k in np.unique(part):
            used, own = np.unique(faces[part == k], return_inverse=True)
            yield seen[:, used], own.reshape(-1, 3), next(colours)


def _render(drapes, folder, size, spp, advance):
    """PNG frames and a video; Mitsuba is loaded here alone."""
    set_variant()
    import cv2

    from polyfit.pictures import stage

    body = drapes[0].body.numpy(), drapes[0].body_faces.numpy(), BODY_COLOUR
    meshes = [body, *_coloured(drapes)]
    frames = folder / "frames"
    frames.mkdir()

    def pictures():
        for k, image in enumerate(stage.render(meshes, size=size, spp=spp)):
            cv2.imwrite(str(frames / f"{k:03d}.png"), image[..., ::-1])
            advance()
            yield image

    write_video(folder / "drape.mp4", pictures(), drapes[0].fps)


def write(
    drapes,
    names,
    folder,
    *,
    skip=(),
    meshes=None,
    size=(480, 360),
    spp=16,
    advance=lambda: None,
):
    """The files of each :class:`onefit.Drape` in the empty ``folder``: of one there, of several in
    a folder each, after their ``names``, and one rendering of all. ``skip``: any of "usd",
    "render".
    """
    folder = Path(folder)
    for drape, name in zip(drapes, _folders(names)):
        (folder / name).mkdir(exist_ok=True)
        _write(drape, folder / name, skip, meshes)
    if "render" not in skip:
        _render(drapes, folder, size, spp, advance)


def _write(drape, folder, skip, meshes):
    """The files of one drape, but for its rendering."""
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
