"""Each term's closed form, gradient and energy, against automatic differentiation of its energy;
each curvature against the change of the gradient.
"""

import copy
import dataclasses

import cv2
import drjit as dr
import numpy as np
import pytest
import surfaces
import synthetic
import trimesh
from problems import dense, problem_of, some_state
from scipy.spatial.transform import Rotation

from polysft_mi.errors import InputError
from polysft_mi.images import Level, Light
from polysft_mi.objective import TERMS, FrameContext, FrameMemory, Objective
from polysft_mi.scene import DepthImages, Tracks
from polysft_mi.scene.cameras import OtherCamera
from polysft_mi.surface.patch import Unknowns

GEOMETRY = (
    "shading chroma tracks depth inextensibility temporal bending coupling sliding relief".split()
)
WEIGHTS = dict(
    k_rgb=0.0,
    k_silhouette=0.0,
    k_tc=0.3,
    k_bend=1e-2,
    k_uv=0.2,
    k_relief=0.4,
    k_shading=9.0,
    k_chroma=9.0,
    tracks="known",  # by observe
    depth="known",
)


@pytest.fixture
def rng():
    """Each test's own, so that its draws do not depend on the tests before it."""
    return np.random.default_rng(4)


def objective_of(problem, *names, **settings):
    """The objective of some terms of a problem, under settings."""
    given = problem.settings
    problem.settings = dataclasses.replace(given, **settings)
    try:
        objective = Objective(problem)
    finally:
        problem.settings = given
    objective.terms = [term for term in objective.terms if term.name in names]
    objective.observe(0, problem.template.vertices)
    assert len(objective.terms) == len(names)
    return objective


def context_of(objective, rng, frame=1, hold=0.0):
    """A frame after others: noise, a light that is known, and a part that no pixel sees."""
    atlas, rules = objective.atlas, objective.rules
    known = np.array([0.8, 0.1, 0.2, -0.4, 0.05, 0.0, 0.1])
    light = Light(20 * np.eye(7), 20 * known, rules)
    anchor = some_state(atlas, rng, 0.01)
    memory = FrameMemory(0.06, least_misfit=0.06, light=light, nat=1e-3, noises={"tracks": 2.0})
    return FrameContext(frame, anchor, memory, objective.visibility(anchor), hold)


def by_autodiff(frozen, state):
    """(energy, gradient by the jets and motions (K, A + 6), by the displacements (N, 3)) of one
    frame, as quadratic models have them.
    """
    atlas = frozen.atlas
    unknowns = Unknowns.from_numpy(atlas.arrays(state))
    dr.enable_grad(unknowns)
    total, _ = frozen.evaluate([unknowns], backward=True)
    grad = {name: np.array(dr.grad(x), dtype=np.float64) for name, x in unknowns.items()}
    count = len(atlas)
    alpha = grad["delta_alpha"].reshape(count, -1) @ atlas.to_monomials
    quaternion, rotation = grad["rotation"].reshape(count, 4), np.zeros((count, 3))
    for axis in range(3):  # the rotation goes on by a small turn about an axis of the world
        turn = Rotation.from_rotvec(1e-6 * np.eye(3)[axis])
        ahead, behind = ((t * state.rotation).as_quat() for t in (turn, turn.inv()))
        ahead *= np.sign((ahead * state.rotation.as_quat()).sum(1, keepdims=True))
        behind *= np.sign((behind * state.rotation.as_quat()).sum(1, keepdims=True))
        rotation[:, axis] = (quaternion * (ahead - behind)).sum(1) / 2e-6
    translation = grad["translation"].reshape(count, 3)
    offset = np.stack([grad[f"delta_{c}"] for c in "uvw"], 1)
    return total, np.concatenate([alpha, rotation, translation], 1), offset


@pytest.fixture(params=["truth", "tube"])
def problem(request, tmp_path, rng):
    """A sheet of one patch, and a sleeve of several; with tracks and depth that are noisy, and in
    part wrong.
    """
    problem = problem_of(request.getfixturevalue(request.param).folder, order=4)
    observe(problem, tmp_path, rng)
    return problem


def observe(problem, folder, rng, points=60):
    """Have a problem's video know of its first surface by tracks, and by depth images in
    ``folder``.
    """
    data, sequence = Objective(problem).data, problem.sequence
    vertices, camera = problem.template.vertices, problem.camera
    at, _ = camera.project(
        vertices[
            rng.choice(
                np.flatnonzero(data.seen_vertices(vertices, problem.rules.blurs[-1])), points
            )
        ]
    )
    positions = np.repeat((at + rng.normal(size=at.shape))[None], len(sequence), 0)
    positions[1:] += rng.normal(size=positions[1:].shape)
    positions[1:, :4] += 20
    visible = rng.uniform(size=positions.shape[:2]) < 0.9
    visible[0] = True
    sequence.tracks = Tracks(positions, visible, np.zeros(points, dtype=int))
    with dr.suspend_grad():
        view = data.view(vertices, Level(0.0))
    (x, y), (w, h) = (int(view.region[k][0]) for k in (0, 1)), view.size
    depth = np.zeros((camera.height, camera.width))
    depth[y : y + h, x : x + w] = np.array(view.depth).reshape(h, w)
    depth = np.where(np.isfinite(depth), depth, 0)
    for k in range(len(sequence)):
        noisy = depth + (depth > 0) * rng.normal(0, 3e-3, depth.shape)
        noisy[rng.uniform(size=depth.shape) < 0.05] += 0.1
        path = str(folder / f"{k:03d}.png")
        assert cv2.imwrite(path, np.round(1e4 * noisy).clip(0, 65535).astype(np.uint16))
    sequence.depth = DepthImages.open(str(folder), len(sequence), list(range(len(sequence))), 1e-4)


@pytest.mark.parametrize("name", GEOMETRY)
def test_closed_forms_are_those_of_automatic_differentiation(problem, name, rng):
    several = len(problem.template) > 1
    if name == "coupling" and not several:
        pytest.skip("one patch is not coupled")
    objective = objective_of(problem, name, **WEIGHTS)
    hold = 0.7 if name == "temporal" else 0.0
    context, state = context_of(objective, rng, hold=hold), some_state(objective.atlas, rng, 0.02)
    frozen = objective.frozen([context], objective.usual[-1], [state])
    total, by_globals, by_offset = by_autodiff(frozen, state)
    (model,) = frozen.quadratic([state])
    assert model.total == pytest.approx(total, rel=2e-4) and total > 0
    mine = model.normal.gradient.reshape(by_globals.shape)
    for part in (slice(0, -6), slice(-6, -3), slice(-3, None)):
        scale = np.abs(by_globals).max() + 1e-12
        assert np.abs(mine - by_globals)[:, part].max() < 3e-3 * scale
    scale = np.abs(by_offset).max() + 1e-12
    assert np.abs(model.normal.local_gradient - by_offset).max() < 3e-3 * scale
    assert max(np.abs(by_globals).max(), np.abs(by_offset).max()) > 1e-6


# what an image shows of a triangle is detached, or its slope a difference; pixels change hands at
# rims
@pytest.mark.parametrize("name", [n for n in GEOMETRY if n not in ("shading", "chroma", "depth")])
def test_curvatures_promise_the_change(problem, name, rng):
    """Where a term is a sum of squares, what its quadratic model promises of a small step is the
    change of its energy; where its norm is robust, or it takes Gauss-Newton's part, no more.
    """
    if name == "coupling" and len(problem.template) == 1:
        pytest.skip("one patch is not coupled")
    objective = objective_of(problem, name, **WEIGHTS)
    context, state = context_of(objective, rng), some_state(objective.atlas, rng, 0.02)
    frozen = objective.frozen([context], objective.usual[-1], [state])
    (model,) = frozen.quadratic([state])
    normal, quadratic = model.normal, name in ("temporal", "bending", "sliding", "relief")
    matrix, gradient = dense(objective.inputs.operators.patterns[3], normal)
    assert np.abs(matrix - matrix.T).max() < 1e-9 * np.abs(matrix).max()
    for size in (1e-6, 1e-2 if quadratic else 1e-5):
        step = rng.normal(size=len(normal.gradient)), rng.normal(size=state.offset.shape)
        if quadratic:  # linear in these; not in the rotations
            step[0].reshape(len(objective.atlas), -1)[:, -6:-3] = 0
        step = tuple(size * x for x in step)
        along = np.concatenate([step[1].ravel(), step[0]])
        (there,) = frozen.quadratic([state.after_step(step)])
        (back,) = frozen.quadratic([state.after_step(step, -1)])
        slope = (there.total - back.total) / 2
        assert along @ gradient == pytest.approx(slope, rel=1e-3, abs=1e-12)
        bend, promised = there.total + back.total - 2 * model.total, along @ matrix @ along
        assert promised >= 0
        if quadratic and size > 1e-5 and not (name == "relief" and len(objective.atlas) > 1):
            assert bend == pytest.approx(promised, rel=1e-5)  # a tube's bends are bounded


@pytest.mark.parametrize("name", ["rgb", "silhouette"])
def test_images_in_closed_form_go_where_automatic_differentiation_goes(problem, name, rng):
    """The photometric term compares a blurred texture where Mitsuba's gradient goes through the
    blurred rendering: energy and slope along the surface's motions are alike.
    """
    weights = {"k_rgb": 0.0, "k_silhouette": 0.0, f"k_{name}": 1.0}
    objective = objective_of(problem, name, **{**WEIGHTS, **weights})
    context = dataclasses.replace(context_of(objective, rng), memory=FrameMemory(0.05))
    state = objective.atlas.state(problem.patch.rest().to_numpy())
    state.translation += 0.01
    frozen = objective.frozen([context], objective.usual[-1], [state])
    total, by_globals, _ = by_autodiff(frozen, state)
    (model,) = frozen.quadratic([state])
    mine = model.normal.gradient.reshape(by_globals.shape)
    a, b = mine[:, -3:].ravel(), by_globals[:, -3:].ravel()
    near = 1e-3 if name == "silhouette" else 0.2
    assert model.total == pytest.approx(total, rel=near / 2)
    assert np.linalg.norm(a - b) < near * np.linalg.norm(b)


def test_what_is_mostly_noise_is_no_measure_of_a_gain(problem, rng):
    weights = {**WEIGHTS, "k_rgb": 1.0}
    objective = objective_of(problem, "rgb", "chroma", "tracks", "depth", **weights)
    state = objective.atlas.state(problem.patch.rest().to_numpy())
    context = context_of(objective, rng)
    (model,) = objective.frozen([context], objective.usual[-1], [state]).quadratic([state])
    assert min(model.terms.values()) > 0
    assert model.measure == pytest.approx(model.terms["rgb"])


def test_another_camera_says_what_the_first_says_from_its_place(problem, rng):
    """At the place of the scene's own camera, it has the same energy, gradient and curvature."""
    weights = {"k_rgb": 2.0, "k_silhouette": 0.5}
    camera = problem.camera.intrinsics()
    problem.sequence.cameras = [OtherCamera("other", camera, np.eye(4), problem.sequence)]
    alone = objective_of(problem, "rgb", "silhouette", **{**WEIGHTS, **weights})
    other = objective_of(problem, "cameras", **{**WEIGHTS, **weights, "cameras": "known"})
    context = dataclasses.replace(context_of(alone, rng), memory=FrameMemory(0.05))
    state = alone.atlas.state(problem.patch.rest().to_numpy())
    state.translation += 0.01
    found = []
    for objective in (alone, other):
        frozen = objective.frozen([context], objective.usual[-1], [state])
        (model,) = frozen.quadratic([state])
        found.append((by_autodiff(frozen, state), model))
    ((total, gradient, offset), a), ((total_, gradient_, offset_), b) = found
    assert total_ == pytest.approx(total, rel=1e-5)
    assert np.abs(gradient_ - gradient).max() < 1e-3 * np.abs(gradient).max()
    assert np.abs(offset_ - offset).max() < 1e-3 * np.abs(offset).max()
    assert b.terms["cameras"] == pytest.approx(sum(a.terms.values()), rel=1e-4)
    for name in ("gradient", "glob", "cross", "local"):  # with the objective's own images
        once, twice = (getattr(model.normal, name) for model in (a, b))
        assert np.abs(twice - 2 * once).max() < 1e-3 * np.abs(once).max(), name


def test_a_camera_says_nothing_of_a_frame_in_which_its_mask_is_empty(truth, rng):
    problem = problem_of(truth.folder, order=4)
    blind, camera = copy.copy(problem.sequence), problem.camera.intrinsics()
    blind.unmasked = frozenset({1})
    problem.sequence.cameras = [OtherCamera("other", camera, np.eye(4), blind)]
    objective = objective_of(problem, "cameras", cameras="known")
    state = objective.atlas.state(problem.patch.rest().to_numpy())
    for frame in (1, 2):
        context = context_of(objective, rng, frame)
        frozen = objective.frozen([context], objective.usual[-1], [state])
        energies = by_autodiff(frozen, state)[0], frozen.quadratic([state])[0].terms["cameras"]
        assert energies == (0, 0) if frame == 1 else min(energies) > 0


def test_a_closed_surface_keeps_its_volume(tmp_path, rng):
    """Of a ball: closed form against automatic differentiation, and against finite differences."""
    truth = synthetic.cloth(tmp_path / "ball", frames=1)
    points, faces = surfaces.sphere(radius=0.1, subdivisions=2)
    template = truth.folder / "template.obj"
    synthetic.write_obj(template, points + truth.vertices[0].mean(0), 5 * points[:, :2], faces)
    problem = problem_of(truth.folder, k_volume=5.0, order=3)
    objective = objective_of(problem, "volume", **{**WEIGHTS, "tracks": "", "depth": ""})
    (term,) = objective.terms
    points, faces = problem.template.vertices, problem.template.faces
    assert abs(term.rest) == pytest.approx(abs(trimesh.Trimesh(points, faces).volume), rel=1e-9)
    context, state = context_of(objective, rng, 0), some_state(objective.atlas, rng, 0.02)
    frozen = objective.frozen([context], objective.usual[-1], [state])
    total, by_globals, by_offset = by_autodiff(frozen, state)
    (model,) = frozen.quadratic([state])
    assert model.total == pytest.approx(total, rel=1e-3) and total > 0
    mine = model.normal.gradient.reshape(by_globals.shape)
    assert np.abs(mine - by_globals).max() < 3e-3 * np.abs(by_globals).max()
    offset = model.normal.local_gradient
    assert np.abs(offset - by_offset).max() < 3e-3 * np.abs(by_offset).max()
    step = rng.normal(size=mine.size) * 1e-6, rng.normal(size=offset.shape) * 1e-6
    ahead, behind = (frozen.quadratic([state.after_step(step, h)])[0].total for h in (1, -1))
    slope = step[0] @ mine.ravel() + (step[1] * offset).sum()
    assert (ahead - behind) / 2 == pytest.approx(slope, rel=1e-4)


def test_an_open_template_has_no_volume(truth):
    with pytest.raises(InputError, match="k_volume = 2, but the template is open"):
        Objective(problem_of(truth.folder, k_volume=2.0))


def test_every_term_is_tested():
    others = {"rgb", "silhouette", "volume", "cameras"}
    worn = {"drape", "pose"}  # in test_worn.py
    assert {kind.name for kind in TERMS} == {*GEOMETRY, *others, *worn}
