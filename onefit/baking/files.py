"""The files of a baked drape: arrays, glTF that plays motions anywhere, and a page that computes
the cloth in the browser.
"""

from __future__ import annotations

import base64
import html
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from onefit.body import Body, skeleton
from onefit.motion import Motion
from polyfit.animation import Skeleton, SkinnedMesh, write_skinned_glb
from polyfit.files import aside, json_text

from .evaluation import Baked

_CLOTH, _SKIN = (0.08, 0.19, 0.42), (0.5, 0.42, 0.37)  # linear RGB
_CHECKED = (0, 10, 30)  # frames in which the page holds itself against the arrays


def write_glb(path: str | os.PathLike[str], baked: Baked, body: Body, motion: Motion) -> None:
    """Binary glTF of ``motion``: the garment, skinned, with its corrective shapes as morph targets,
    and the ``body`` on the same joints; an animation moves joints and weights.
    """
    motion = motion.resampled(baked.fps)
    poses, translation = motion.poses.numpy(), motion.translation.numpy()
    moving = Skeleton(
        skeleton.JOINTS, baked.parents, baked.steps, baked.inverse, poses, baked.pace * translation
    )
    skin = dict(joint_of=baked.joint_of, joint_weights=baked.joint_weights, colour=_CLOTH)
    weights = baked.weights(poses, translation)
    cloth = SkinnedMesh(
        baked.name, baked.mean, baked.faces, shapes=baked.shapes, weights=weights, **skin
    )
    of, shares = _strongest(body)
    person = SkinnedMesh("body", body.vertices, body.faces, of, shares, colour=_SKIN)
    write_skinned_glb(path, [person, cloth], moving, fps=baked.fps)


def write_page(
    path: str | os.PathLike[str], baked: Baked, body: Body, motions: Sequence[Motion]
) -> None:
    """One HTML file, without anything beside it, that computes ``baked`` and the ``body`` in
    ``motions`` and draws them by WebGL 2. It says how far it is from the package's own arrays.
    """
    motions = [m.resampled(baked.fps) for m in motions]
    of, shares = _strongest(body)
    first = motions[0]
    frames = [k for k in _CHECKED if k < len(first)]
    vertices = baked.vertices(first.poses.numpy(), first.translation.numpy())
    packed = {name: _packed(value) for name, value in vars(baked).items() if name[0] != "_"}
    lowest = float(body.vertices[:, 2].min())
    data = dict(
        baked={k: v for k, v in packed.items() if k not in ("steps", "inverse")},
        body=dict(
            vertices=_packed(body.vertices.numpy()), faces=_packed(body.faces.numpy()),
            joint_of=_packed(of), joint_weights=_packed(shares),
        ),
        motions=[
            dict(
                name=m.name,
                poses=_packed(m.poses.numpy()),
                translation=_packed(m.translation.numpy()),
            )
            for m in motions
        ],
        check=dict(frames=frames, vertices=_packed(vertices[frames])),
        ground=lowest,
        centre=(lowest + float(body.vertices[:, 2].max())) / 2,
    )  # fmt: skip
    page = (resources.files("onefit") / "data" / "baked.html").read_text(encoding="utf-8")
    page = page.replace("{{title}}", html.escape(f"{baked.name}, baked"))
    page = page.replace("{{data}}", json_text(data).replace("<", "\\u003c"))
    with aside(path) as temporary:
        Path(temporary).write_text(page, encoding="utf-8")


def is_in_page(path: str | os.PathLike[str], motion: str) -> bool:
    """Whether a page of :func:`write_page` plays the motion of that name."""
    begins = json_text({"name": motion, "poses": 0}).removesuffix("0}").replace("<", "\\u003c")
    return begins in Path(path).read_text(encoding="utf-8", errors="replace")


def _strongest(body):
    """The four joints (V, 4) int64 that move each vertex of a body most, and their weights."""
    largest = body.blend_weights.topk(4, 1)
    return largest.indices.numpy(), (largest.values / largest.values.sum(1, keepdim=True)).numpy()


def _packed(value):
    """A value as the page takes it; arrays as their bytes, in base64."""
    if isinstance(value, tuple):
        return [_packed(x) for x in value]
    if not isinstance(value, np.ndarray):
        return value
    kind = "i" if value.dtype.kind in "iu" else "f"
    raw = np.ascontiguousarray(value, np.dtype("<i4" if kind == "i" else "<f4")).tobytes()
    return dict(type=kind, values=base64.b64encode(raw).decode("ascii"))
