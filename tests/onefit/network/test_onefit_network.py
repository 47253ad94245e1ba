import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from surfaces import ball

import onefit
from onefit.body import AnnyBody, ClosestSurface
from onefit.draping import Draper, ease
from onefit.garment import Garment
from onefit.motion import Motion
from onefit.network import EXTRAS, OneFit, weights
from onefit.network.network import LEAKY_SLOPE, Decoder, descriptors, encoded
from polyfit.errors import InputError
from polyfit.mesh import edges_of


@pytest.fixture(scope="module")
def model():
    return AnnyBody()


def perturbed(seed=0, size=0.1):
    """A network whose heads say something, as a trained one's do."""
    torch.manual_seed(seed)
    network = OneFit()
    with torch.no_grad():
        for head in network.decoder.heads.values():
            head[-1].weight.normal_(0, size)
    return network.eval()


@pytest.fixture(scope="module")
def draper(model):
    return Draper(weights.Trained(perturbed(), "anny", ("tank",)), model)


@pytest.fixture(scope="module")
def walk():
    return Motion.generate("walk", seconds=0.7, seed=3)


def test_positional_encoding():
    x = torch.tensor([[0.25, 0.0]])
    assert encoded(x, 2).tolist()[0] == pytest.approx(
        [0.25, 0, 0.5**0.5, 1, 0, 0, 0.5**0.5, 0, 1, 1], abs=1e-6
    )


def test_descriptors_are_rotations_and_gravity_seen_from_the_joints():
    g = torch.Generator().manual_seed(0)
    poses = 0.5 * torch.randn(2, 3, 24, 3, generator=g)
    found = descriptors(poses)
    assert found.shape == (2, 3, 24, 9)
    a, b, down = found.split(3, -1)
    for x in (a, b, down):
        assert torch.allclose(x.norm(dim=-1), torch.ones(1), atol=1e-5)
    assert (a * b).sum(-1).abs().max() < 1e-5
    # standing: gravity points down in every joint; turning about the vertical does not change what
    # a joint feels of it
    upright = torch.zeros(1, 24, 3)
    assert torch.allclose(descriptors(upright)[0, :, 6:], torch.tensor([0.0, 0, -1]).expand(24, 3))
    turned = upright.clone()
    turned[0, 0] = torch.tensor([0, 0, 1.3])
    assert torch.allclose(
        descriptors(turned)[0, :, 6:], torch.tensor([0.0, 0, -1]).expand(24, 3), atol=1e-6
    )
    # on its face, a body feels gravity towards its front, -y
    face = upright.clone()
    face[0, 0] = torch.tensor([torch.pi / 2, 0, 0])
    assert torch.allclose(descriptors(face)[0, 0, 6:], torch.tensor([0.0, -1, 0]), atol=1e-6)


def test_the_patch_encoder_reads_all_it_is_given():
    encoder = perturbed().patches
    g = torch.Generator().manual_seed(0)
    inputs = [
        torch.randn(5, *size, generator=g) for size in ((15,), (7,), (3,), (3,), (1,), (24,))
    ] + [torch.randn(24, 3, generator=g)]
    codes = encoder(*inputs)
    for k, x in enumerate(inputs):
        assert (encoder(*inputs[:k], x + 0.1, *inputs[k + 1 :]) - codes).abs().max() > 1e-4


def test_the_decoder_is_that_of_the_concatenation():
    torch.manual_seed(1)
    decoder = perturbed().decoder
    Z_T, Z_B = torch.randn(5, 128), torch.randn(3, 256)
    out = decoder(Z_T, Z_B)
    weight = torch.cat([decoder.of_patch.weight, decoder.of_body.weight], 1)
    both = torch.cat([Z_T[None].expand(3, 5, 128), Z_B[:, None].expand(3, 5, 256)], -1)
    x = torch.nn.functional.leaky_relu(both @ weight.T + decoder.of_patch.bias, LEAKY_SLOPE)
    expected = decoder.heads["translation"](decoder.trunk(x))
    assert torch.allclose(out.translation, expected * 0.3, atol=1e-5)
    assert out.alpha.shape == (3, 5, 15) and out.scale.shape == (3, 5)


def test_layers_are_those_of_the_paper():
    network = OneFit()
    widths = lambda layers: [
        (m.in_features, m.out_features) for m in layers if isinstance(m, torch.nn.Linear)
    ]
    assert widths(network.body.static) == [(216, 64), (64, 128), (128, 256), (256, 512)]
    assert widths(network.body.local) == [(9, 32), (32, 32)] and widths(network.body.moving) == [
        (771, 512),
        (512, 512),
    ]
    assert network.body.memory.hidden_size == 512
    assert not any(
        "bias" in name
        for part in (network.body.local, network.body.moving)
        for name, _ in part.named_parameters()
    )
    assert [b for _, b in widths(network.body.join)][:4] == [256] * 4 and len(
        widths(network.body.join)
    ) == 5
    assert widths(network.decoder.trunk) == [(512, 512), (512, 512), (512, 256)]
    assert all(
        [b for _, b in widths(head)][:2] == [128, 64] for head in network.decoder.heads.values()
    )


def test_the_paper_s_network_has_the_paper_s_inputs_alone(tmp_path, model):
    torch.manual_seed(2)
    paper, ours = OneFit(extras=()), OneFit()
    sizes = [n.patches.first[0].in_features for n in (paper, ours)]
    assert sizes[0] == 15 + 7 + 3 * 13 + 3 * 24 * 7 and sizes[1] == sizes[0] + 3 + 1 + 24
    assert paper.body.moving[0].in_features == 32 * 24 and not paper.body.memory.bias
    assert set(paper.decoder.heads) == {"alpha", "translation", "scale"}
    assert not hasattr(paper.patches, "whole")
    # looseness, held and blend weights change nothing, and no patch knows of another
    g = torch.Generator().manual_seed(0)
    inputs = [torch.randn(5, n, generator=g) for n in (15, 7, 3, 3, 1, 24)]
    joints = torch.randn(24, 3, generator=g)
    codes = paper.patches(*inputs, joints)
    assert torch.equal(paper.patches(*inputs[:3], *(x + 1 for x in inputs[3:]), joints), codes)
    alone = paper.patches(*(x[:1] for x in inputs), joints)
    assert torch.allclose(alone, codes[:1], atol=1e-5)
    # it is told where the body faces
    poses = 0.3 * torch.randn(1, 4, 24, 3, generator=g)
    turned = poses.clone()
    turned[:, :, 0] = torch.tensor([0.0, 0, 1.3])
    poses[:, :, 0] = 0
    embed = lambda n, x: n.body(x, torch.zeros(1, 4, 3), torch.zeros(1, 6), 30.0)[0]
    assert torch.allclose(embed(ours, poses), embed(ours, turned), atol=1e-5)
    assert (embed(paper, poses) - embed(paper, turned)).abs().max() > 1e-3
    # files know what it has; those of before have all
    weights.save(tmp_path / "paper.safetensors", paper, model, ())
    again = weights.load(tmp_path / "paper.safetensors").network
    assert again.shape == paper.shape
    assert again.patching == dict(order=4, frames="pca", acvd=False, waistband=False)
    assert onefit.load("six-garments").network.shape["extras"] == list(EXTRAS)


@pytest.mark.parametrize("extra", EXTRAS)
def test_each_extra_has_a_switch(extra):
    g = torch.Generator().manual_seed(1)
    network = OneFit(extras=[name for name in EXTRAS if name != extra])
    codes = network.patches(
        *(torch.randn(5, n, generator=g) for n in (15, 7, 3, 3, 1, 24)), torch.zeros(24, 3)
    )
    poses = torch.randn(1, 3, 24, 3, generator=g)
    embedding = network.body(poses, torch.zeros(1, 3, 3), torch.zeros(1, 6), 30.0)[0][0]
    out = network.decoder(codes, embedding)
    assert out.alpha.shape == (3, 5, 15) and out.drift.shape == (3, 5, 3)
    whole, less = (sum(p.numel() for p in n.parameters()) for n in (OneFit(), network))
    assert less < whole or extra == "free_heading"


def test_a_body_at_rest_leaves_the_dynamic_encoding_at_zero():
    body = perturbed().body
    poses = 0.3 * torch.randn(1, 1, 24, 3, generator=torch.Generator().manual_seed(2)).expand(
        1, 12, 24, 3
    )
    _, memory = body(poses, torch.zeros(1, 12, 3), torch.zeros(1, 6), 30.0)
    assert memory.abs().max() < 1e-5
    _, moving = body(
        poses * torch.linspace(0, 1, 12)[:, None, None],
        torch.zeros(1, 12, 3),
        torch.zeros(1, 6),
        30.0,
    )
    assert moving.abs().max() > 1e-3
    # a memory that was anything fades while the body stands still, but not at once
    noise = torch.randn(1, 1, 512, generator=torch.Generator().manual_seed(3))
    rest = lambda frames: body(
        poses[:, :1].expand(1, frames, 24, 3),
        torch.zeros(1, frames, 3),
        torch.zeros(1, 6),
        30.0,
        noise,
    )[1].norm()
    assert rest(10) > 0.2 * noise.norm() and rest(300) < 0.01 * noise.norm()


def test_the_memory_goes_on_where_it_stopped():
    body = perturbed().body
    g = torch.Generator().manual_seed(4)
    poses, translation = 0.3 * torch.randn(1, 8, 24, 3, generator=g), torch.zeros(1, 8, 3)
    whole, _ = body(poses, translation, torch.zeros(1, 6), 30.0)
    again, _ = body(poses, translation, torch.zeros(1, 6), 30.0)
    assert torch.equal(whole, again)
    shape, _ = body(poses, translation, 0.2 * torch.ones(1, 6), 30.0)
    moved, _ = body(
        poses, translation + torch.arange(8)[None, :, None] * 0.05, torch.zeros(1, 6), 30.0
    )
    turned = poses.clone()
    turned[0, 4:, 0, 2] += 0.5
    spun, _ = body(turned, translation, torch.zeros(1, 6), 30.0)
    for other in (shape, moved, spun):
        assert (whole - other).abs().max() > 1e-4
    elsewhere, _ = body(poses, translation + 3.0, torch.zeros(1, 6), 30.0)
    assert torch.allclose(whole, elsewhere, atol=1e-4)  # where the body stands does not matter


def test_an_untrained_network_is_plain_skinning(model, walk):
    torch.manual_seed(0)
    fresh = Draper(weights.Trained(OneFit().eval(), "anny", ()), model)
    assert torch.equal(
        fresh.drape("tank", walk, post=False).vertices,
        fresh.drape("tank", walk, skinning_only=True).vertices,
    )


def test_draping_in_batches_is_draping_at_once(draper, walk, monkeypatch):
    whole, alone = (draper.drape("tank", walk, post=post).vertices for post in (True, False))
    assert whole.shape == (len(walk), len(Garment.template("tank")), 3)
    monkeypatch.setattr(onefit.draping.draper, "POINTS", 5 * whole.shape[1])
    assert torch.allclose(draper.drape("tank", walk, post=False).vertices, alone, atol=1e-5)
    # a vertex on the verge of being pushed out may go either way by rounding, and others follow
    assert (draper.drape("tank", walk).vertices - whole).abs().mean() < 1e-4
    assert (whole - draper.drape("tank", walk, skinning_only=True).vertices).abs().max() > 1e-3


def test_place_and_direction_of_a_motion_only_move_the_drape(draper, walk):
    # turned about the vertical and set elsewhere: the cloth turns and goes with it
    import roma

    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 0, 0.8]))
    root = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(walk.poses[:, 0]))
    poses = torch.cat([root[:, None], walk.poses[:, 1:]], 1)
    place = draper.standard.joints[0]
    other = dataclasses.replace(
        walk,
        poses=poses,
        translation=(walk.translation + place) @ turn.T - place + torch.tensor([1.0, 2.0, 0]),
    )
    for post in (False, True):
        a, b = (draper.drape("tank", motion, post=post).vertices for motion in (walk, other))
        away = (b - a @ turn.T - torch.tensor([1.0, 2.0, 0])).norm(dim=-1)
        # rounding decides which way a vertex on the verge of being pushed out goes
        assert away.mean() < 1e-4 if post else away.max() < 1e-4


def test_post_processing_leaves_nothing_inside(draper, walk):
    raw = draper.drape("tank", walk, post=False)
    assert raw.measures().collision > 0.3
    assert draper.drape("tank", walk).measures().collision < 0.1


def test_post_processing_brings_lengths_back(draper, walk):
    garment = draper.garment("tank")
    edges = torch.as_tensor(edges_of(garment.faces.numpy())[0])
    lengths = garment.rest_lengths(edges)
    raw, out = (draper.drape("tank", walk, post=post).vertices for post in (False, True))
    strain = lambda x: (
        ((x[:, edges[:, 0]] - x[:, edges[:, 1]]).norm(dim=-1) / lengths - 1).abs().mean()
    )
    assert strain(out) < 0.7 * strain(raw)
    assert (out - raw).norm(dim=-1).mean() < 0.01  # it hangs where it hung


def test_ease_takes_away_what_a_network_does_wrongly_in_most_frames():
    (vertices, faces), (rest, triangles) = ball(0.1), ball(0.11, 3)
    body = SimpleNamespace(vertices=vertices, faces=faces)
    surface = ClosestSurface(vertices, faces)
    deep, seldom = rest[:, 2] > 0.09, rest[:, 2] < -0.09
    frames = []
    for k in range(40):
        move = torch.zeros(len(rest), 3)
        move[deep] = -0.08 * rest[deep]  # 9 mm towards the middle, always
        move[seldom] = -0.08 * rest[seldom] * (k == 0)
        push = torch.tensor([0.1 * k, 0.0, 0.0])  # the body goes on, and the cloth with it
        frames.append((rest + move + push, rest + push, vertices + push))
    offset = ease.ease(rest, triangles, body, frames)
    assert surface(frames[0][0] + offset, 1.0).distance[deep].min() > 0.9 * ease.EASED
    assert not offset[seldom].any()  # wrong in one frame of forty only
    assert not offset[rest[:, 2] < 0].any()
    # where the cloth was made nearer than that, or skinning brings it nearer, it may be there
    near = rest * (0.101 / 0.11)
    offset = ease.ease(near, triangles, body, [(near * 0.98, near, vertices)] * 5)
    assert 0.0005 < surface(near * 0.98 + offset, 1.0).distance.min() < 0.0015
    assert not ease.ease(rest, triangles, body, [(rest * 0.92, rest * 0.92, vertices)] * 5).any()


def test_ease_looks_at_the_centres_of_coarse_triangles():
    (vertices, faces), (rest, triangles) = (
        ball(0.1, 4),
        ball(0.125, 1),
    )  # with sides of 7 cm: the centres are 7 mm nearer
    body = SimpleNamespace(vertices=vertices, faces=faces)
    surface = ClosestSurface(vertices, faces)
    sunk = rest * (0.107 / 0.125)
    distance = lambda x: surface(x, 1.0).distance.min()
    assert (
        distance(rest[triangles].mean(1)) > 0.01
        and distance(sunk) > 0.0069
        and distance(sunk[triangles].mean(1)) < 0.001
    )
    eased = sunk + ease.ease(rest, triangles, body, [(sunk, rest, vertices)] * 5)
    assert distance(eased[triangles].mean(1)) > 0.004


def test_ease_keeps_a_network_out_of_the_body(model, walk):
    draper = Draper(
        weights.Trained(perturbed(1, 0.15), "anny", ("tank",)), model
    )  # ten times as much inside as skinning
    garment = draper.garment("tank")
    offset = draper.ease(garment)
    assert offset is draper.ease(garment) and offset.shape == garment.vertices.shape
    assert 0 < offset.norm(dim=-1).max() < 0.1
    eased, alone = (draper.drape("tank", walk, post=False, eased=e) for e in (True, False))
    plain = draper.drape("tank", walk, skinning_only=True)
    assert alone.measures().collision > 2 * plain.measures().collision
    assert eased.measures().collision < 0.7 * alone.measures().collision


def test_weights_in_eight_bits_drape_alike(draper, model, walk, tmp_path):
    path = tmp_path / "weights.safetensors"
    weights.save(path, draper.network, model, ("tank",))
    assert path.stat().st_size < 1.1 * sum(p.numel() for p in draper.network.parameters())
    loaded = onefit.load(path, model=model)
    assert loaded.trained.garments == ("tank",)
    a, b, c = (
        draper.drape("tank", walk, eased=False, post=False),
        loaded.drape("tank", walk, eased=False, post=False),
        draper.drape("tank", walk, skinning_only=True),
    )
    # eight bits cost a few per cent of the deformation
    assert (a.vertices - b.vertices).norm(dim=-1).mean() < 0.05 * (a.vertices - c.vertices).norm(
        dim=-1
    ).mean()


def test_refused_weights(tmp_path, model, draper):
    with pytest.raises(InputError, match="no such file, nor one of the package's"):
        onefit.load("nothing")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"no weights")
    with pytest.raises(InputError, match="not a file of weights"):
        onefit.load(bad)
    path = tmp_path / "old.safetensors"
    version, weights.VERSION = weights.VERSION, 0
    try:
        weights.save(path, draper.network, model, ())
    finally:
        weights.VERSION = version
    with pytest.raises(InputError, match="weights of version 0"):
        onefit.load(path)


def test_decoder_of_another_order():
    assert Decoder(3)(torch.zeros(2, 128), torch.zeros(1, 256)).alpha.shape == (1, 2, 10)


def test_a_body_of_another_kind_is_draped_too(draper, walk, tmp_path):
    # Anny's own surface as a plain file is another kind: the network is told the standard shape,
    # and the drape is that of the standard body
    body = draper.standard
    path = tmp_path / "body.npz"
    np.savez(
        path,
        **{
            name: getattr(body, name).numpy()
            for name in ("vertices", "faces", "blend_weights", "joints", "rest_pose")
        },
        parents=np.array(body.parents),
    )
    other = Draper(draper.trained, onefit.PlainBody(path))
    a, b = (d.drape("tank", walk, eased=False, post=False) for d in (draper, other))
    assert (a.vertices - b.vertices).norm(dim=-1).max() < 0.005
