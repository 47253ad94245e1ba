"""Where a video does not tell which of two surfaces it shows, both are tracked until it does.

Seen from afar a sheet and its mirror image, hollow where it bulges, look alike: shape from one view
has these two answers at least. While the sheet is nearly flat rounding decides between them, and
when it bends more, no small step leads from the wrong one to the right one. NumPy only.
"""

import dataclasses
import math

import numpy as np

# terms that fall where a relief follows folds, and not where it follows noise
_WITNESSES = ("silhouette", "shading", "chroma", "tracks", "depth", "cameras")


def plane_of(vertices):
    """(middle, unit normal), (3,) each, of the plane of least squares of vertices (N, 3) [m]."""
    middle = vertices.mean(0)
    return middle, np.linalg.svd(vertices - middle, full_matrices=False)[2][2]


def mirrored(vertices, origin):
    """Vertices (N, 3) [m] as far before their :func:`plane_of` as ``vertices`` are behind it, and
    the other way round, each along its ray from ``origin`` (3,) [m].
    """
    middle, normal = plane_of(vertices)
    from_origin = vertices - origin
    on_plane = ((middle - origin) @ normal) / (from_origin @ normal)
    return origin + (2 * on_plane - 1)[:, None] * from_origin


def split(track, frame):
    """Let the ``track`` have another branch, which begins at the ``frame`` and is a copy of it so
    far; returns that.
    """
    own = {f.name: getattr(track, f.name) for f in dataclasses.fields(track)}
    copies = {name: x.copy() for name, x in own.items() if isinstance(x, (list, dict))}
    track.other, track.fork = dataclasses.replace(track, **copies), frame
    return track.other


def _first_solved(track):
    return next(k for k, memory in enumerate(track.memories) if memory)


def second_pass(track):
    """A track that is a copy of the ``track`` up to the first frame that was solved, and tells the
    frames after it to be bold.
    """
    first = _first_solved(track)
    memory = dataclasses.replace(track.memories[first], bold=True)
    again = type(track)(solver=track.solver, fork=first + 1, next_window=first + 1)
    for name in ("states", "iterations", "seconds", "totals", "memories"):
        setattr(again, name, getattr(track, name)[: first + 1])
    again.memories[first] = memory
    for name in ("lost", "unusable", "certainty"):
        setattr(again, name, {k: x for k, x in getattr(track, name).items() if k <= first})
    return again


def settle(track, share):
    """Let the track be its second pass where the witnesses cost less by the ``share``; the one that
    is not kept is dropped. Frames that either lost do not count.
    """
    again, since = track.again, _first_solved(track) + 1
    seconds = [a + b for a, b in zip(track.seconds[since:], again.seconds[since:], strict=True)]
    both = [k for k in range(since, len(track.totals)) if k not in {*track.lost, *again.lost}]
    own, others = (
        sum(t.totals[k].get(name) or 0.0 for k in both for name in _WITNESSES)
        for t in (track, again)
    )
    is_better = others < (1 - share) * own and len(again.lost) <= len(track.lost)
    if is_better:
        become(track, again)
    track.seconds[since:], track.again = seconds, None
    track.second = "kept" if is_better else "dropped"


def ahead(track):
    """How much more the track has cost than its other branch since they parted, over what a frame
    costs; infinite where it lost more frames, or fewer. What both lost tells nothing.
    """
    since = range(track.fork, len(track.totals))
    own, others = (np.array([_cost(t, k) for k in since]) for t in (track, track.other))
    more_lost = int(np.isinf(own).sum() - np.isinf(others).sum())
    if more_lost:
        return math.copysign(math.inf, more_lost)
    both = np.isfinite(own) & np.isfinite(others)
    if not both.any():
        return 0.0
    own, others = own[both], others[both]
    return float((own - others).sum() / np.minimum(own, others).mean())


def _cost(track, frame):
    known = [x for x in track.totals[frame].values() if x is not None]
    return math.inf if frame in track.lost else sum(known)


def decide(track, apart=0.0):
    """Whether the branches are at least so many frames' costs ``apart``; then the cheaper one
    becomes the track, and the other its other branch.
    """
    difference = ahead(track)
    decided = abs(difference) >= apart
    if decided and difference > 0:
        swap(track)
    return decided


def swap(track):
    """Let the other branch be the track, and the track the other."""
    other, fork = track.other, track.fork
    kept = dataclasses.replace(track, other=None)
    become(track, other)
    track.other, track.fork = kept, fork


def become(track, other):
    """Let the track be a copy of the other one."""
    for f in dataclasses.fields(track):
        setattr(track, f.name, getattr(other, f.name))
