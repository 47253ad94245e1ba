"""Shading as a cue: its derivatives against finite differences, its algebra against dense matrices,
the light that it learns against the true one.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
from problems import data_of, problem_of

from polysft_mi.images.light import Brightness, Light, residuals
from polysft_mi.images.triangles import TriangleColours, luminance
from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.scene.rules import Rules
from polysft_mi.solvers.linear import Reduced
from polysft_mi.tracker import FrameTracker, track

LIGHT = np.array([0.6, 0.3, -0.2, -0.35, 0.05, -0.08, 0.04])
K = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])
ROWS, COLUMNS = 7, 9
FACES = synthetic.grid_faces(ROWS, COLUMNS)


def project(vertices):
    x = vertices @ K.T
    return x[:, :2] / x[:, 2:]


def brightness(luminance=0.5, masked=False):
    """That of a sheet of one colour, or of an image (64, 64) of luminances over the texture
    coordinates.
    """
    texture = np.broadcast_to(np.asarray(luminance, np.float32)[..., None], (64, 64, 3))
    texture, inside = (
        np.pad(texture, ((8, 8), (8, 8), (0, 0)), "edge"),
        np.pad(np.ones((64, 64), np.float32), 8),
    )
    v, u = np.meshgrid(np.linspace(71, 8, ROWS), np.linspace(8, 71, COLUMNS), indexing="ij")
    texels = np.stack([u, v], -1).reshape(-1, 2)[FACES].mean(1)
    flat = synthetic.sheet(0, ROWS, COLUMNS)
    baked = SimpleNamespace(image=texture, inside=inside, density=1.5, centroids=lambda: texels)
    return Brightness(TriangleColours(FACES, project(flat), baked, masked, Rules()), flat)


def shade_of(found, vertices, image, seen=1e9, mask=None):
    colour = np.broadcast_to(np.asarray(image, np.float32)[..., None], (120, 160, 3))
    return found.of(
        found.colours.of_frame(colour, mask),
        vertices,
        np.zeros(3),
        project(vertices),
        np.full(len(FACES), seen),
    )


def known(light=LIGHT):
    """A light that has been seen often."""
    return Light(1e9 * np.eye(7), 1e9 * light, Rules())


def wavy(seed=0, size=0.004):
    rng = np.random.default_rng(seed)
    return synthetic.sheet(0.5, ROWS, COLUMNS) + size * rng.normal(size=(ROWS * COLUMNS, 3))


def lit(vertices):
    """What a triangle is lit with by LIGHT, (F,)."""
    return (
        LIGHT[0]
        + normals(vertices) @ LIGHT[1:4]
        + (vertices[FACES].mean(1) - (0, 0, 0.5)) / 0.12 @ LIGHT[4:]
    )


def normals(vertices):
    a, b, c = (vertices[FACES[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.where(((n * (a + b + c)).sum(1) < 0)[:, None], n, -n)


def test_residuals_and_derivatives():
    found, vertices = brightness(masked=True), wavy()
    energy, residual, factor, by_corner = residuals(shade_of(found, vertices, 0.4), known(), 12.0)
    exposure = np.median(0.8 / lit(vertices))
    np.testing.assert_allclose(residual, 0.8 / exposure - lit(vertices), atol=1e-6)
    a, b, c = (vertices[FACES[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    scale = Rules().light_scale
    assert energy == pytest.approx(
        12 * scale**2 * (area / area.sum() * np.log1p((residual / scale) ** 2)).sum(), rel=1e-5
    )
    np.testing.assert_allclose(
        factor, 24 * area / area.sum() / (1 + (residual / scale) ** 2), rtol=1e-6
    )
    h = 1e-6
    for corner in range(3):
        for axis in range(3):
            for face in (0, 17, 61):
                moved = vertices.copy()
                moved[FACES[face, corner], axis] += h
                plus = lit(moved)[face]
                moved[FACES[face, corner], axis] -= 2 * h
                minus = lit(moved)[face]
                assert by_corner[face, corner, axis] == pytest.approx(
                    (minus - plus) / (2 * h), rel=1e-4, abs=1e-5 * np.abs(by_corner).max()
                )


def test_the_light_follows_the_surface_and_the_energy_has_no_slope_along_it():
    found, vertices = brightness(masked=True), wavy()
    light = Light(
        np.diag([5.0, 1, 1, 1, 2, 2, 2]),
        np.diag([5.0, 1, 1, 1, 2, 2, 2]) @ LIGHT,
        Rules(light_refits=60),
    )
    shade = shade_of(found, vertices, 0.4)
    fit = light.fit(shade)
    before = light.coefficients(len(FACES))
    assert np.abs(fit.coefficients - before).max() > 0.05 and fit.departure > 0

    def at(
        vertices, image=shade.luminance
    ):  # what the image shows at another place is no derivative
        return residuals(
            dataclasses.replace(shade_of(found, vertices, 0.4), luminance=image, area=shade.area),
            light,
            12.0,
        )

    _, residual, factor, by_corner = at(vertices)
    gradient = np.zeros_like(vertices)
    np.add.at(gradient, FACES, (factor * residual)[:, None, None] * by_corner)
    # the frame's exposure follows too: only vertices whose triangles are not those of the median
    ratio = shade.luminance / (
        shade.texture * (before[0] + shade.normal @ before[1:4] + shade.centre @ before[4:])
    )
    middle = np.argsort(ratio)[len(FACES) // 2 - 1 : len(FACES) // 2 + 1]
    free = np.setdiff1d(np.arange(len(vertices)), FACES[middle])
    h = 1e-6
    for i in free[::9]:
        for axis in range(3):
            energy = []
            for step in (h, -h):
                moved = vertices.copy()
                moved[i, axis] += step
                energy.append(at(moved)[0])
            assert gradient[i, axis] == pytest.approx(
                (energy[0] - energy[1]) / (2 * h), rel=1e-3, abs=1e-4 * np.abs(gradient).max()
            )


@pytest.mark.parametrize("exposure", [0.5, 1.7])
def test_a_frames_exposure_changes_nothing(exposure):
    found = brightness(masked=True)
    light = known().updated(shade_of(found, wavy(), 0.4))
    for brighter, usual in zip(
        residuals(shade_of(found, wavy(), 0.4 * exposure), light, 12.0),
        residuals(shade_of(found, wavy(), 0.4), light, 12.0),
    ):
        np.testing.assert_allclose(brighter, usual, rtol=1e-5, atol=1e-7)
    assert known().updated(shade_of(found, wavy(), 0.4 * exposure)).numbers() == pytest.approx(
        light.numbers(), rel=1e-5
    )


def test_what_a_frame_shows_of_each_triangle():
    y, x = np.mgrid[:64, :64] / 63
    texture = 0.4 + 0.2 * x + 0.1 * y
    found, vertices = brightness(texture), synthetic.sheet(0, ROWS, COLUMNS)
    shade = shade_of(found, vertices, 0.7 * found.colours.mean)
    assert shade.luminance == pytest.approx(0.7, rel=1e-5)
    assert shade.texture[shade.seen].mean() == pytest.approx(1, rel=1e-5)
    u, v = ((vertices[FACES].mean(1) / (0.12, 0.09, 1))[:, :2].T + 1) / 2
    np.testing.assert_allclose(
        shade.texture[shade.seen] * found.colours.mean,
        (0.4 + 0.2 * u + 0.1 * (1 - v))[shade.seen],
        atol=0.01,
    )
    assert (shade.normal @ [0, 0, -1] > 0.999).all() and shade.area.sum() == pytest.approx(
        0.24 * 0.18, rel=1e-6
    )


def test_only_triangles_that_are_seen_count():
    found, flat = brightness(masked=True), synthetic.sheet(0, ROWS, COLUMNS)
    assert shade_of(found, flat, 0.4, seen=1.0).seen.all()
    assert not shade_of(found, flat, 0.4, seen=0.0).seen.any()
    assert not brightness(
        np.zeros((64, 64)), masked=True
    ).colours.trusted.any()  # a black texture says nothing


def test_a_frame_larger_than_its_triangles_need_is_shrunk():
    found = brightness(masked=True).colours
    found.sigma = 6.0
    image, pool = found.of_frame(
        np.full((120, 160, 3), 0.4, np.float32), np.ones((120, 160), np.float32)
    )
    assert pool == 3 and image.shape == (40, 53, 3) and image == pytest.approx(0.8, rel=1e-5)


def test_the_light_is_learned_from_surfaces_that_bend():
    rng = np.random.default_rng(1)
    found, light = brightness(masked=True), Light.unknown(Rules())
    assert not light.is_known
    for k in range(20):
        shade = shade_of(found, wavy(k, 0.01), 0.4)
        value = lit(wavy(k, 0.01)) + 0.005 * rng.normal(size=len(FACES))
        value[rng.random(len(FACES)) < 0.1] += 0.5  # a highlight, a shadow's end
        light = light.updated(dataclasses.replace(shade, luminance=value))
    learned = light.coefficients(len(FACES))
    assert light.is_known
    assert learned * (LIGHT[0] / learned[0]) == pytest.approx(LIGHT, abs=0.03)
    assert Light.of(light.numbers(), Rules()).numbers() == light.numbers()


def test_the_last_frames_say_most():
    found, light = brightness(masked=True), Light.unknown(Rules())
    slopes = []
    for k in range(30):  # in the first ten frames the light comes a little less from the side
        vertices = wavy(k, 0.01)
        value = lit(vertices) - 0.08 * normals(vertices)[:, 0] * (k < 10)
        light = light.updated(dataclasses.replace(shade_of(found, vertices, 0.4), luminance=value))
        level, slope = light.coefficients(len(FACES))[:2]
        slopes.append(slope / level * LIGHT[0])
    assert slopes[9] == pytest.approx(LIGHT[1] - 0.08, abs=0.015) and slopes[29] == pytest.approx(
        LIGHT[1], abs=0.015
    )


def test_the_light_of_mirror_images_is_the_mirror_image_of_the_light():
    """What frames say of the light if their surfaces are reflected, from the surfaces alone."""
    found, surfaces = brightness(), [wavy(seed) for seed in range(3)]
    middle, normal = np.array([0.01, -0.02, 0.51]), np.array([0.1, -0.2, 1.0])
    normal /= np.linalg.norm(normal)
    images = [v - 2 * ((v - middle) @ normal)[:, None] * normal for v in surfaces]
    lights = []
    for vertices in (surfaces, images):
        matrix, right = np.zeros((7, 7)), np.zeros(7)
        for v, bright in zip(vertices, map(lit, surfaces), strict=True):
            shade = shade_of(found, v, 0.5)
            rows = np.column_stack([np.ones(len(FACES)), shade.normal, shade.centre])
            matrix, right = matrix + rows.T @ rows, right + rows.T @ bright
        lights.append(Light(matrix, right, Rules()))
    distance = (middle - found.centre) @ normal / found.unit
    mirrored = lights[0].mirrored(normal, distance)
    assert np.allclose(mirrored.matrix, lights[1].matrix)
    assert np.allclose(mirrored.right, lights[1].right)
    kept = Light.of(mirrored.numbers(), mirrored.rules)  # as a checkpoint does
    assert np.array_equal(kept.matrix, mirrored.matrix)
    assert not np.allclose(lights[0].right, lights[1].right, rtol=0.1)
    back = mirrored.mirrored(normal, distance)
    assert np.allclose(back.matrix, lights[0].matrix)


def test_a_flat_sheet_says_nothing_of_where_the_light_comes_from():
    found, light = brightness(masked=True), Light.unknown(Rules())
    for _ in range(20):
        light = light.updated(shade_of(found, synthetic.sheet(0, ROWS, COLUMNS), 0.4))
    level, *slope = light.coefficients(len(FACES))
    across = level - slope[2]  # what a sheet across the view is lit with, but for the exposure
    assert (
        across == pytest.approx(1, rel=1e-3)
        and np.abs(slope[:2]).max() < 1e-6
        and np.abs(slope[3:]).max() < 1e-4
    )
    assert light.updated(shade_of(found, synthetic.sheet(0, ROWS, COLUMNS), 0.4, seen=0)) == light


def test_what_no_frame_tells_is_an_unknown_light():
    assert not Light.of(None, Rules()).is_known
    assert Light.of(known().numbers(), Rules()).is_known


# -- in the tracker ----------------------------------------------------------


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("light") / "cloth"
    return synthetic.cloth(folder, frames=5, size=(160, 120), rows=9, columns=12, light=LIGHT[:4])


@pytest.fixture(scope="module")
def tracked(truth, tmp_path_factory):
    """All frames, followed under a light that is learned."""
    problem = problem_of(truth.folder)
    folder = str(tmp_path_factory.mktemp("whole"))
    return track(FrameTracker(problem), 5, folder)


def test_the_tracker_learns_the_light_and_follows_it(truth, tracked, tmp_path):
    problem = problem_of(truth.folder, k_shading=0.0)
    off = track(FrameTracker(problem), 3, str(tmp_path))
    assert not off.memories[-1].light.is_known and "shading" not in off.totals[-1]
    found = tracked.memories[-1].light
    assert found.is_known
    assert tracked.totals[0]["shading"] == 0 < tracked.totals[-1]["shading"]
    # the sheet rolls about the image's upright: that is where the light's slope shows
    slope = found.coefficients(len(truth.faces))[1]
    assert 0.5 < slope / (LIGHT[1] / (LIGHT[0] - LIGHT[3])) < 1.5


def test_what_is_known_of_the_light_survives_an_interruption(truth, tracked, tmp_path):
    problem = problem_of(truth.folder)

    class Interrupted(Exception):
        pass

    def stop(frame, vertices):
        if frame == 2:
            raise Interrupted

    with pytest.raises(Interrupted):
        track(FrameTracker(problem), 5, str(tmp_path), solved=stop)
    resumed = track(FrameTracker(problem), 5, str(tmp_path), resume=True)
    assert resumed.memories[-1].light.numbers() == tracked.memories[-1].light.numbers()
    assert all(
        np.array_equal(a[name], b[name])
        for a, b in zip(tracked.states, resumed.states)
        for name in a
    )


def test_a_texture_that_moves_takes_its_colours_along(truth):
    problem = problem_of(truth.folder)
    images = data_of(problem)
    before, chart = images.colours.colour, problem.template.chart[:, 0]
    assert images.move_texture(chart, chart + 0.1)
    assert np.abs(images.colours.colour - before).max() > 0.05


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_only_the_last_stage_is_shaded_and_a_step_goes_where_the_shading_leads(truth, stage):
    problem = problem_of(truth.folder, k_rgb=0.0, k_silhouette=0.0, k_mi=0.0, k_relief=0.0, order=4)
    objective = Objective(problem)
    stage, rest = objective.usual[stage], problem.atlas.state(problem.patch.rest().to_numpy())
    # what an image shows at another place is no derivative
    light = known(LIGHT * (1, 1, 1, 1, 0, 0, 0))
    context = FrameContext(1, rest, FrameMemory(light=light))
    frozen = objective.frozen([context], stage, [rest])
    (model,) = frozen.quadratic([rest])
    shading, normal = model.terms["shading"], model.normal
    assert (shading > 0) == stage.last == bool(np.abs(normal.gradient).max() > 1e-9)
    if shading:
        step, _ = Reduced.of(objective.inputs.operators.patterns, normal, 1e-3).step()
        slope = step[0] @ normal.gradient + (step[1] * normal.local_gradient).sum()
        (there,) = frozen.quadratic([rest.after_step(step, 0.1)])
        # less than the slope says, for the exposure follows
        assert 0.1 * slope < there.terms["shading"] - shading < 0.02 * slope < 0


def test_what_a_light_makes_of_each_triangle():
    found, vertices = brightness(), wavy()
    each = lit(vertices)
    around = [[t for t, face in enumerate(FACES) if k in face] for k in range(len(vertices))]
    expected = [np.mean([each[around[k]].mean() for k in face]) for face in FACES]
    assert np.allclose(found.irradiance(vertices, np.zeros(3), LIGHT), expected)
    turned = found.faces[:, ::-1].copy()
    found.faces = turned  # whichever way triangles are listed
    assert np.allclose(found.irradiance(vertices, np.zeros(3), LIGHT), expected)
    from_behind = np.array([0.1, 0, 0, -3.0, 0, 0, 0])
    one, other = (found.irradiance(vertices, np.zeros(3), k * from_behind) for k in (1, -1))
    assert min(one.min(), other.min()) == 0 < max(one.max(), other.max())  # no light is less


def test_a_textures_colours_as_an_image_shows_them():
    found, vertices = brightness(), synthetic.sheet(0, ROWS, COLUMNS)
    image = np.broadcast_to(
        np.linspace(0.2, 0.8, 80, dtype=np.float32)[None, :, None], (60, 80, 3)
    )  # on a grid of two pixels
    value = found.colours.of_rendering(
        image, np.ones((60, 80), np.float32), 2, project(vertices) / 2
    )
    x = project(vertices)[FACES].mean(1)[:, 0] / 2 - 0.5
    assert np.allclose(value * found.colours.mean, (0.2 + 0.6 * x / 79)[:, None], atol=1e-3)
    assert np.array_equal(
        shade_of(found, vertices, np.full((120, 160), 0.5)).texture, luminance(found.colours.colour)
    )
    known = found.of(
        found.colours.of_frame(np.full((120, 160, 3), 0.5, np.float32), None),
        vertices,
        np.zeros(3),
        project(vertices),
        np.full(len(FACES), 1e9),
        value,
    )
    assert np.array_equal(known.texture, luminance(value))
