"""What PolyFit is trained on: the analytic families, random smooth maps, patches of meshes."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import j0

from polyfit import InputError
from polyfit.jets import CanonicalFrame
from polyfit.training import deformations, families, garments


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


UV = 2 * torch.rand(3, 40, 2, generator=generator(), dtype=torch.float64) - 1
A, THETA, SIGMA = (
    torch.tensor(x, dtype=torch.float64)
    for x in ([0.3, -0.4, 0.5], [3.2, 5.0, 6.2], [0.5, 0.7, 1.0])
)
CENTRE = torch.tensor([[0.2, -0.3], [0.0, 0.0], [-0.8, 0.5]], dtype=torch.float64)
JET = torch.rand(3, 15, generator=generator(1), dtype=torch.float64) - 0.5
KINDS = {
    "jet": lambda uv: families.jet(JET, uv),
    "trigonometric": lambda uv: families.trigonometric(A, THETA, uv),
    "gaussian": lambda uv: families.gaussian(A, CENTRE, SIGMA, uv),
    "bessel": lambda uv: families.bessel(A, CENTRE, uv),
}


def written_out(name, k, u, v):
    """The paper's formula for one patch and one point."""
    if name == "jet":
        return sum(
            JET[k, i * (i + 1) // 2 + j].item() * u ** (i - j) * v**j
            for i in range(5)
            for j in range(i + 1)
        )
    u0, v0 = CENTRE[k].tolist()
    if name == "trigonometric":
        return A[k].item() * np.cos(THETA[k].item() * np.sqrt(u * u + v * v))
    if name == "gaussian":
        return A[k].item() * np.exp(-((u - u0) ** 2 + (v - v0) ** 2) / (2 * SIGMA[k].item() ** 2))
    return A[k].item() * j0(5 * np.sqrt((u - u0) ** 2 + (v - v0) ** 2))


@pytest.mark.parametrize("name", families.FAMILIES)
def test_heights_are_those_of_the_paper(name):
    z, _ = KINDS[name](UV)
    expected = [[written_out(name, k, *uv) for uv in UV[k].tolist()] for k in range(3)]
    assert z.numpy() == pytest.approx(np.array(expected), abs=1e-6)  # torch has J0 to 2e-7


@pytest.mark.parametrize("name", families.FAMILIES)
def test_slopes_are_derivatives_of_heights(name):
    uv = torch.cat(
        [UV, CENTRE[:, None], torch.zeros(3, 1, 2, dtype=torch.float64)], 1
    )  # centres, where r has none
    _, slope = KINDS[name](uv)
    for axis in range(2):
        h = torch.zeros(2, dtype=torch.float64)
        h[axis] = 1e-6
        difference = (KINDS[name](uv + h)[0] - KINDS[name](uv - h)[0]) / 2e-6
        assert slope[..., axis].numpy() == pytest.approx(
            difference.numpy(), abs=2e-6
        )  # torch has J0 to 2e-7


def test_samples_are_graphs_with_their_normals_within_the_paper_s_ranges():
    points, normals = families.sample(200, 64, generator(), ("gaussian",))
    assert points[..., :2].abs().max() <= 1 and points[..., 2].abs().max() <= 0.5
    assert (
        points[..., 2].amax(1).max() > 0.4 and points[..., 2].amin(1).min() < -0.4
    )  # both signs, the whole range
    assert normals.norm(dim=-1).numpy() == pytest.approx(1) and (normals[..., 2] > 0).all()
    summed, _ = families.sample(200, 64, generator())
    assert summed[..., 2].abs().max() > 1  # four functions together


def test_unknown_family_is_refused():
    with pytest.raises(InputError, match="families cosine: choose among jet"):
        families.sample(1, 8, generator(), ("cosine",))


def test_maps_carry_normals_as_they_carry_tangents():
    maps = deformations.random(20, generator())
    maps = deformations.SmoothMaps(*(getattr(maps, f).double() for f in maps.__dataclass_fields__))
    x = 0.5 * torch.randn(20, 30, 3, generator=generator(1), dtype=torch.float64)
    n = torch.nn.functional.normalize(
        torch.randn(20, 30, 3, generator=generator(2), dtype=torch.float64), dim=-1
    )
    y, carried = maps.map_with_normals(x, n)
    assert torch.equal(y, maps(x))
    t = torch.linalg.cross(n, torch.randn(20, 30, 3, generator=generator(3), dtype=torch.float64))
    h = 1e-5
    # the strongest bend depends on the patch's outermost points: moving one alone is a derivative
    # at fixed strength only inside
    inner = (x.norm(dim=-1) < 0.5 * x.norm(dim=-1).amax(1, keepdim=True))[..., None]
    moved = (maps(torch.where(inner, x + h * t, x)) - maps(torch.where(inner, x - h * t, x))) / (
        2 * h
    )
    moved, carried = moved[inner[..., 0]], carried[inner[..., 0]]
    assert len(moved) > 50
    cosine = (torch.nn.functional.normalize(moved, dim=-1) * carried).sum(-1)
    assert cosine.abs().max() < 1e-6


def test_maps_turn_no_space_inside_out():
    maps = deformations.random(100, generator())
    x = torch.nn.functional.normalize(torch.randn(100, 50, 3, generator=generator(1)), dim=-1)
    columns = [torch.func.jvp(maps, (x,), (torch.eye(3)[k].expand_as(x),))[1] for k in range(3)]
    determinant = torch.linalg.det(torch.stack(columns, -1))
    assert (
        determinant > 0
    ).float().mean() > 0.98  # stretches may bring a later wave's steepness above 1 in places
    identity = deformations.random(3, generator(), stretch=0, bend=0, steepness=0)
    assert identity(x[:3]).numpy() == pytest.approx(x[:3].numpy(), abs=1e-5)


def test_a_bend_rolls_a_strip_onto_a_cylinder_without_stretching_it():
    along = torch.linspace(-1, 1, 21)
    strip = torch.stack([along, torch.zeros(21), torch.zeros(21)], -1)[None]
    rolled = deformations._bend(strip, torch.eye(3)[None], torch.tensor([[2.0]]))
    assert (rolled[0] - torch.tensor([0, 0, 0.5])).norm(dim=-1).numpy() == pytest.approx(
        0.5, abs=1e-6
    )
    angle = torch.atan2(rolled[0, :, 0], 0.5 - rolled[0, :, 2])
    assert angle.numpy() == pytest.approx(2 * along.numpy(), abs=1e-5)


def test_patches_of_a_sphere_lie_on_it_evenly():
    ball = trimesh.creation.icosphere(4, radius=0.3)
    patches = garments.GarmentPatches.cut(
        ball.vertices, ball.faces, 12, 200, np.random.default_rng(0)
    )
    assert patches.points.shape == patches.normals.shape == (12, 200, 3)
    radius = patches.points.norm(dim=-1)
    assert radius.min() > 0.298 and radius.max() <= 0.3001
    assert (patches.normals * patches.points / radius[..., None]).sum(-1).min() > 0.999
    share = (
        (patches.points[..., 2] > 0.15).float().mean()
    )  # a cap of half the height: a quarter of the sphere (Archimedes)
    assert share.item() == pytest.approx(0.25, abs=0.03)


def test_deformed_patches_are_those_of_the_mesh_taken_through_maps(tmp_path):
    ball = trimesh.creation.icosphere(3)
    ball.export(tmp_path / "ball.ply")
    patches = garments.cut_meshes([tmp_path / "ball.ply"], (4, 9), 64, 0)
    assert len(patches) == 13
    same = patches.deformed(5, generator(), stretch=0, bend=0, steepness=0)
    picked = torch.randint(13, (5,), generator=generator())
    frame = CanonicalFrame.from_points(patches.points[picked])
    assert same.points.numpy() == pytest.approx(
        frame.to_chart(patches.points[picked]).numpy(), abs=1e-5
    )
    assert same.normals.numpy() == pytest.approx(
        (patches.normals[picked] @ frame.R).numpy(), abs=1e-4
    )
    bent = patches.deformed(5, generator())
    assert (bent.points - same.points).abs().max() > 0.1


def test_a_file_that_is_no_mesh_is_refused(tmp_path):
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match="empty.obj.*no faces"):
        garments.cut_meshes([tmp_path / "empty.obj"], (4,), 64, 0)
