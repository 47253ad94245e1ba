"""Bodies from files: models of the SMPL family, and plain ``body.npz`` files. None is needed, none
comes with OneFit.

Whatever their files hold, all bodies come out in OneFit's axes and in its standard A-pose, their
root joint where the standard body has it.
"""

from __future__ import annotations

import os
import pickle

import numpy as np
import torch

from polyfit.errors import InputError
from polyfit.files import as_path, read_npz
from polyfit.mesh import checked

from . import skeleton, skinning
from .body import Body, BodyModel, largest_component

# from SMPL's axes (y up, facing +z) to OneFit's (z up, facing -y); x is the left in both
FROM_SMPL = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_UNPICKLING = (
    pickle.UnpicklingError,
    AttributeError,
    IndexError,
    KeyError,
    TypeError,
)  # what reading a broken pickle may end in
_THUMBS = {
    52: (34, 49),
    55: (37, 52),
}  # first joint of the left and right thumb, for 52 and 55 joints
_HANDS = {52: (22, 37), 55: (25, 40)}  # first joint of the left and right hand


def _reduction(count):
    """(joint (count,) that each of 24, 52 (SMPL-H) or 55 (SMPL-X) joints moves with; places (24,
    count), weights of joints in a joint's place).

    Fingers move with the hand, whose place is the middle of their first joints; thumbs with the
    wrist; jaw and eyes with the head.
    """
    body = 24 if count == 24 else 22
    of = [*range(body)]
    places = np.zeros((24, count))
    places[range(body), range(body)] = 1
    if count != 24:
        of += [skeleton.INDEX["head"]] * (_HANDS[count][0] - 22)
        for side, hand, thumb in zip(("left", "right"), _HANDS[count], _THUMBS[count], strict=True):
            of += [skeleton.INDEX[f"{side}_hand"]] * (thumb - hand) + [
                skeleton.INDEX[f"{side}_wrist"]
            ] * 3
            places[skeleton.INDEX[f"{side}_hand"], range(hand, thumb, 3)] = 0.25
    return np.array(of), places


def _reduced(path, weights, joints, parents):
    """(weights (V, 24), joints (24, 3)) of a body with 24, 52 or 55 joints of the SMPL family."""
    count = joints.shape[0]
    if count not in (24, 52, 55):
        raise InputError(
            f"{path}: {count} joints; 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) are needed"
        )
    if weights.ndim != 2 or weights.shape[1] != count:
        raise InputError(
            f"{path}: blend weights of shape {weights.shape}; (vertices, {count}) is needed"
        )
    parents = np.asarray(parents).astype(np.int64).ravel()
    body = 24 if count == 24 else 22
    if parents.shape != (count,) or (parents[1:body] != skeleton.PARENTS[1:body]).any():
        raise InputError(f"{path}: its joints' parents are not those of SMPL's skeleton")
    of, places = _reduction(count)
    return weights @ np.eye(24)[of], places @ joints


def _rested(path, vertices, faces, weights, joints, rest_pose, shape, kind):
    """The :class:`~onefit.Body` of arrays in OneFit's axes, brought from the stand
    ``rest_pose`` to the standard A-pose by skinning."""
    wide, deep, tall = np.ptp(vertices, axis=0)
    if tall < 0.6 * max(wide, deep):
        raise InputError(
            f"{path}: a body {tall:.2g} units tall, {wide:.2g} wide and {deep:.2g} deep; one that"
            " stands upright is needed (in SMPL's files y is up)"
        )
    if not 0.4 < tall < 2.8:
        unit = next(
            (
                f"; in {name}? then divide by {per}"
                for name, per in (("cm", 100), ("mm", 1000))
                if 0.4 < tall / per < 2.8
            ),
            "",
        )
        raise InputError(f"{path}: a body {tall:.4g} units tall; metres are needed{unit}")
    sums = weights.sum(1)
    if not (np.isfinite(weights).all() and (weights > -1e-6).all() and (sums > 1e-3).all()):
        raise InputError(
            f"{path}: blend weights that are negative, not finite, or zero for a whole vertex"
        )
    low, high = vertices.min(0) - 0.1, vertices.max(0) + 0.1
    if ((joints < low) | (joints > high)).any() or np.ptp(joints[:, 2]) < 0.5 * tall:
        raise InputError(
            f"{path}: its joints are not all over the body, from feet to head; those that belong to"
            " its vertices are needed"
        )
    tensor = lambda a: torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32)
    body = Body(
        tensor(vertices),
        torch.as_tensor(faces.astype(np.int64)),
        tensor(weights / sums[:, None]),
        tensor(joints),
        tensor(rest_pose),
        shape,
        kind,
    )
    target = skeleton.standard_rest_pose()
    place = skeleton.standard_joints()[0] - body.joints[0]
    A = skinning.transforms(body, target[None], place[None])
    vertices = skinning.skin(body.vertices, body.blend_weights, A)[0]
    return Body(
        vertices,
        body.faces,
        body.blend_weights,
        skinning.posed_joints(body, A)[0],
        target,
        shape,
        kind,
    )


class SmplBody(BodyModel):
    """A model of the SMPL family from its own file, ``.npz`` or ``.pkl``: SMPL, SMPL-H, SMPL-X
    (also STAR's and others' of the same keys).

    Read are ``v_template``, ``f``, ``weights``, ``J_regressor``, ``kintree_table`` and
    ``shapedirs``; the shape is its first ten betas (or as many as there are). ``posedirs`` are left
    out: OneFit skins linearly. SMPL's zero pose is OneFit's T-pose; from there the surface is
    brought to the standard A-pose by skinning, which flattens it a little at the armpits, as SMPL
    without its pose blend shapes does. Raises InputError for a file that cannot be read, misses a
    key, or whose shapes do not fit.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        data = _read(
            path, ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
        )
        V, F = data["v_template"], data["f"].astype(np.int64)
        checked(V, F, str(path))
        regressor, shapedirs = data["J_regressor"], data["shapedirs"]
        for name, shape, needed in (
            ("J_regressor", regressor.shape, (data["weights"].shape[-1], len(V))),
            ("shapedirs", shapedirs.shape[:2], (len(V), 3)),
            ("weights", data["weights"].shape[:1], (len(V),)),
        ):
            if shape != needed:
                raise InputError(
                    f"{path}: {name} of shape {shape} does not fit; {needed} is needed"
                )
        kept = largest_component(len(V), torch.as_tensor(F)).numpy()
        self.kind, self._path = "smpl", path
        self._basis = shapedirs[:, :, :10].astype(np.float64)
        self._vertices, self._weights, self._regressor = (
            a.astype(np.float64) for a in (V, data["weights"], regressor)
        )
        parents = data["kintree_table"][0].astype(np.int64)
        self._parents = np.where(parents < len(self._regressor), parents, -1)
        self._kept, self._faces = kept, (np.cumsum(kept) - 1)[F[kept[F].all(1)]]
        self.shape_names = tuple(f"beta{k}" for k in range(self._basis.shape[2]))
        self.standard_shape = torch.zeros(len(self.shape_names))

    def body(self, shape: torch.Tensor | None = None) -> Body:
        shape = self._shape(shape)
        vertices = self._vertices + self._basis @ shape.double().numpy()
        weights, joints = _reduced(
            self._path, self._weights, self._regressor @ vertices, self._parents
        )
        turn = FROM_SMPL.double().numpy().T
        kept = self._kept
        rest = np.zeros((24, 3))
        return _rested(
            self._path,
            vertices[kept] @ turn,
            self._faces,
            weights[kept],
            joints @ turn,
            rest,
            shape,
            self.kind,
        )

    def shape_of(self, betas: np.ndarray | None) -> torch.Tensor:
        """The shape (S,) of betas, of which there may be fewer or more; None is the mean shape."""
        shape = self.standard_shape.clone()
        known = np.asarray([] if betas is None else betas)[: len(shape)]
        shape[: len(known)] = torch.as_tensor(known).float()
        return shape

    def root(self, shape: torch.Tensor | None = None) -> np.ndarray:
        """The root joint (3,) [m, in SMPL's axes] of a shape in SMPL's zero pose: a translation of
        SMPL's leads from there.
        """
        vertices = self._vertices + self._basis @ self._shape(shape).double().numpy()
        return self._regressor[0] @ vertices

    def random_shape(self, rng: np.random.Generator) -> torch.Tensor:
        """Betas (S,) from the normal distribution that SMPL's are scaled to, cut off at ±2."""
        return torch.from_numpy(np.clip(rng.standard_normal(len(self.shape_names)), -2, 2)).float()


class PlainBody(BodyModel):
    """One body without shape parameters from a ``body.npz`` as Neural Cloth Simulation keeps them.

    ``vertices`` (V, 3) [m], ``faces`` (F, 3 or 4), ``blend_weights`` (V, J), ``joints`` (J, 3) [m],
    ``parents`` (J,) for the J = 24 joints of SMPL (or 52, 55), and ``rest_pose`` (J, 3), the
    axis-angle pose [rad] that takes the T-pose to the stand of the vertices; zero for a body in the
    T-pose. y or z may be up (the head tells). Raises InputError for a file that cannot be read,
    misses a key, or has another skeleton or unit.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        data = _read(path, ("vertices", "faces", "blend_weights", "joints", "rest_pose", "parents"))
        V, F = data["vertices"].astype(np.float64), data["faces"].astype(np.int64)
        if F.ndim == 2 and F.shape[1] == 4:
            F = np.concatenate([F[:, [0, 1, 2]], F[:, [0, 2, 3]]])
        V, F = checked(V, F, str(path))
        joints, rest = data["joints"].astype(np.float64), data["rest_pose"].astype(np.float64)
        if data["blend_weights"].shape[:1] != (len(V),):
            raise InputError(
                f"{path}: blend weights for {data['blend_weights'].shape[0]} vertices; there are"
                f" {len(V)}"
            )
        weights, places = _reduced(
            path, data["blend_weights"].astype(np.float64), joints, data["parents"]
        )
        if rest.shape != joints.shape:
            raise InputError(
                f"{path}: rest_pose of shape {rest.shape}; axis-angle vectors {joints.shape} are"
                " needed"
            )
        rest = rest[: 24 if len(rest) == 24 else 22]
        rest = np.concatenate([rest, np.zeros((24 - len(rest), 3))])
        up = places[skeleton.INDEX["head"]] - places[0]
        if up.argmax() == 1:
            V, places, rest = (a @ FROM_SMPL.double().numpy().T for a in (V, places, rest))
        elif up.argmax() != 2 or up[2] < 0.8 * np.linalg.norm(up):
            raise InputError(
                f"{path}: its head is at {np.round(up, 2).tolist()} from its pelvis; a body that"
                " stands along y or z is needed"
            )
        if places[skeleton.INDEX["left_hip"], 0] < places[skeleton.INDEX["right_hip"], 0]:
            raise InputError(f"{path}: its left is at -x; a body whose left is at +x is needed")
        kept = largest_component(len(V), torch.as_tensor(F)).numpy()
        F = (np.cumsum(kept) - 1)[F[kept[F].all(1)]]
        self.kind, self.shape_names, self.standard_shape = "plain", (), torch.zeros(0)
        self._body = _rested(
            path, V[kept], F, weights[kept], places, rest, self.standard_shape, self.kind
        )

    def body(self, shape: torch.Tensor | None = None) -> Body:
        self._shape(shape)
        return self._body

    def random_shape(self, rng: np.random.Generator) -> torch.Tensor:
        """The empty shape (0,): this body has one shape only."""
        return self.standard_shape


# --- reading --------------------------------------------------------------------------------------


def _read(path, keys):
    """Arrays by name from an ``.npz`` or ``.pkl`` file. Raises InputError."""
    path = as_path(path, "body")
    try:
        if path.lower().endswith(".npz"):
            data = read_npz(path, keys, "a body")
        elif path.lower().endswith(".pkl"):
            with open(path, "rb") as file:
                held = _Arrays(file, encoding="latin1").load()
            if not isinstance(held, dict):
                raise InputError(f"{path}: holds no dictionary of arrays")
            data = {key: _array(held[key], f"{path}: {key}") for key in keys if key in held}
        else:
            raise InputError(f"{path}: a body is read from .npz or .pkl")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError, EOFError, *_UNPICKLING) as error:
        raise InputError(
            f"{path}: cannot be read as a body ({' '.join(str(error).split())[:200]})"
        ) from None
    missing = [key for key in keys if key not in data]
    if missing:
        raise InputError(f"{path}: misses {', '.join(missing)}; a body file has {', '.join(keys)}")
    for key, array in data.items():
        if array.dtype.kind not in "fiu" or (
            array.dtype.kind == "f" and not np.isfinite(array).all()
        ):
            raise InputError(f"{path}: {key} holds values that are not finite numbers")
    return data


class _Held:
    """Stands for an object of another package in a pickle: its state is kept, no code of its own is
    run.
    """

    def __init__(self, *args):
        self.args = args

    def __setstate__(self, state):
        self.state = state


class _Arrays(pickle.Unpickler):
    """Unpickles dictionaries of NumPy arrays, SciPy's sparse matrices and chumpy's arrays, and
    refuses whatever else a pickle can name: a pickle from anywhere could run any code."""

    _NUMPY = {"_reconstruct", "scalar", "ndarray", "dtype", "_frombuffer"}

    def find_class(self, module, name):
        module = {"copy_reg": "copyreg", "__builtin__": "builtins"}.get(
            module, module
        )  # Python 2's names
        top = module.partition(".")[0]
        if top == "numpy" and name in self._NUMPY:
            return super().find_class(
                module.replace("numpy.core", "numpy._core") if hasattr(np, "_core") else module,
                name,
            )
        if top == "scipy" and name in ("csc_matrix", "csr_matrix", "csc_array", "csr_array"):
            return type(name, (_Held,), {})
        if top == "chumpy":
            return type(name, (_Held,), {})
        if (module, name) in (
            ("collections", "OrderedDict"),
            ("copyreg", "_reconstructor"),
            ("builtins", "object"),
            ("_codecs", "encode"),
        ):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(
            f"it names {module}.{name}, which could run code; only arrays are accepted"
        )


def _array(value, what):
    """The array of a value of :class:`_Arrays`. Raises InputError."""
    if isinstance(value, _Held):
        from scipy import sparse

        state = getattr(value, "state", None)
        state = state if isinstance(state, dict) else {}
        name = type(value).__name__
        if name[:3] in ("csc", "csr") and {"data", "indices", "indptr"} <= set(state):
            shape = state.get("_shape", state.get("shape"))
            kind = sparse.csc_matrix if name.startswith("csc") else sparse.csr_matrix
            return kind((state["data"], state["indices"], state["indptr"]), shape=shape).toarray()
        if isinstance(state.get("x"), np.ndarray):
            return state["x"]
        raise InputError(f"{what} is a {name}, which cannot be read; save the model as .npz")
    return np.asarray(value)
