"""``python -m polyfit.train``: the table that is trained on, resuming, several processes, what it
refuses.
"""

import json
from dataclasses import replace

import pytest
import torch
import trimesh
from processes import two_ranks
from safetensors.torch import load_file

from polyfit import InputError, PolyFit, jets, train
from polyfit.baselines import DGCNN, AtlasNet, PointNet
from polyfit.training import (
    Processes,
    Settings,
    Training,
    discrepancy,
    garments,
    trainer,
    training_set,
)

SMALL = Settings(
    families=("gaussian", "jet"), patches=120, points=40, reads=30, steps=8, batch=16, order=2
)
FLAGS = (
    "--families gaussian jet --patches 120 --points 40 --reads 30 --steps 8 --batch 16 --order 2"
).split()


@pytest.fixture(scope="module")
def table():
    return training_set.build(60, 50, 3, 0)


@pytest.fixture
def mesh(tmp_path):
    tube = trimesh.creation.cylinder(0.1, 0.4, sections=24).subdivide().subdivide()
    tube.export(tmp_path / "tube.ply")
    return str(tmp_path / "tube.ply")


def test_table_is_the_loss_of_jets_fitted_along_each_axis(table):
    axes = training_set.axes()
    for patch, k in ((0, 0), (7, 13), (41, 64)):
        z = axes[k]
        u = torch.linalg.cross(z, torch.tensor([0.3, -0.5, 0.9]))  # any axes across z will do
        u = u / u.norm()
        turn = torch.stack([u, torch.linalg.cross(z, u), z], 1)
        x, n = table.points[patch] @ turn, table.normals[patch] @ turn
        d = discrepancy(jets.fit(x, 3).alpha[None], x[None], n[None])
        assert table.height[patch, k].item() == pytest.approx(d.height.item(), rel=1e-3)
        assert table.loss[patch, k].item() == pytest.approx(
            (d.height + training_set.NORMAL_WEIGHT * (1 - d.cosine)).item(), rel=1e-3
        )


def test_table_is_read_sharply_or_smoothly(table):
    index, axes = torch.tensor([3, 8]), training_set.axes()
    height, loss = table.at(index, axes[[20, 30]].expand(2, 2, 3), 1e5)
    assert torch.equal(height, table.height[index][:, [20, 30]]) and torch.equal(
        loss, table.loss[index][:, [20, 30]]
    )
    below, _ = table.at(
        index, -axes[[20, 30]].expand(2, 2, 3), 1e5
    )  # a jet seen from below is a jet
    assert torch.equal(below, height)
    smooth, _ = table.at(index, axes[None, :2].expand(2, 2, 3), 0.0)
    assert smooth.numpy() == pytest.approx(
        table.height[index].mean(1, keepdim=True).expand(2, 2).numpy(), rel=1e-5
    )


def test_axes_cover_the_half_sphere():
    axes = training_set.axes()
    assert axes.norm(dim=1).numpy() == pytest.approx(1, abs=1e-6) and (axes[:, 2] > 0).all()
    anywhere = torch.nn.functional.normalize(
        torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    assert torch.rad2deg(torch.arccos((anywhere @ axes.T).abs().amax(1))).max() < 15


def test_training_lowers_the_loss(tmp_path):
    settings = replace(SMALL, steps=60, batch=64)
    data = trainer.PatchBatches(training_set.build(300, 40, 2, 0, names=("gaussian", "jet")))
    training = trainer.PolyFitTraining(settings, data, Processes("cpu"))

    def loss():
        with torch.no_grad():
            return data.loss(
                training.network,
                settings,
                0.0,
                torch.Generator().manual_seed(1),
                training.processes,
            ).item()

    before = loss()
    for _ in range(60):
        training.step()
    assert loss() < 0.97 * before


def test_command_leaves_weights_their_making_and_a_log(tmp_path, capsys):
    train.main([*FLAGS, "-o", str(tmp_path / "out")])
    assert str(tmp_path / "out" / "weights.safetensors") in capsys.readouterr().out
    model = PolyFit.load(tmp_path / "out" / "weights.safetensors", 2)
    assert model(torch.rand(3, 30, 3)).jet.alpha.shape == (3, 6)
    about = json.loads((tmp_path / "out" / "weights.json").read_text())
    assert about["command"] == "python -m polyfit.train " + " ".join(
        [*FLAGS, "-o", str(tmp_path / "out")]
    )
    assert (about["steps"], about["seed"], about["processes"]) == (8, 0, 1)
    lines = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [8] and 0 < lines[0]["loss"] < 1
    assert not list((tmp_path / "out").glob(".*"))


def test_the_paper_s_loss_turns_frames_to_where_jets_fit():
    settings = replace(SMALL, turns=1, pca=False, loss="height", lr=3e-3, steps=60, batch=64)
    made = training_set.build(300, 40, 2, 0, names=("gaussian", "jet"), table=False)
    assert made.loss.shape == made.height.shape == (300, 0)
    data = trainer.PatchBatches(made)
    training = trainer.PolyFitTraining(settings, data, Processes("cpu"))

    def height():
        """Of all patches, in the frames of the network, by other means than the loss."""
        with torch.no_grad():
            fit = training.network(made.points)
            x = fit.frame.to_chart(made.points)
            d = discrepancy(fit.jet.alpha, x, made.normals @ fit.frame.R)
            return d.height.mean().item()

    pca = PolyFit(2)(made.points)
    x = pca.frame.to_chart(made.points)
    of_pca = discrepancy(pca.jet.alpha, x, made.normals @ pca.frame.R).height.mean().item()
    before = height()
    assert before == pytest.approx(of_pca, rel=0.2)  # it starts near PCA's frame
    for _ in range(60):
        training.step()
    assert height() < 0.98 * min(before, of_pca)


def test_the_gradient_of_the_paper_s_loss_is_that_of_finite_differences():
    settings = replace(SMALL, turns=1, pca=False, loss="height", batch=30, reads=30)
    made = training_set.build(60, 40, 2, 0, names=("gaussian", "jet"), table=False)
    double = training_set.TrainingSet(
        *(x.double() for x in (made.points, made.normals, made.height, made.loss))
    )
    data, processes = trainer.PatchBatches(double), Processes("cpu")
    network = settings.network().double()
    weights = list(network.parameters())

    def loss():
        return data.loss(network, settings, 0.0, torch.Generator().manual_seed(1), processes)

    gradient = torch.autograd.grad(loss(), weights)
    generator = torch.Generator().manual_seed(2)
    way = [torch.randn(w.shape, generator=generator, dtype=torch.float64) for w in weights]
    slope = sum((g * d).sum() for g, d in zip(gradient, way)).item()
    values = []
    with torch.no_grad():
        for step in (-1e-6, 2e-6):
            for w, d in zip(weights, way):
                w.add_(d, alpha=step)
            values.append(loss().item())
    assert (values[1] - values[0]) / 2e-6 == pytest.approx(slope, rel=1e-4)


def test_the_paper_s_preset(mesh, tmp_path):
    args = train.parser().parse_args([mesh, "-o", "OUT", "--preset", "paper", "--lr", "0.1"])
    assert (args.turns, args.pca, args.loss, args.cuts) == (1, False, "height", ["paper"])
    assert (args.subdivided, args.acvd, args.deformed, args.decay) == (4, True, False, False)
    assert (args.batch, args.patches * args.garment_share, args.lr) == (512, 100_000, 0.1)
    small = "--patches 80 --points 40 --reads 30 --steps 3 --batch 16 --subdivided 2".split()
    train.main([mesh, "-o", str(tmp_path / "out"), "--preset", "paper", *small])
    model = PolyFit.load(tmp_path / "out" / "weights.safetensors", 4)
    assert model.stn.shape["turns"] == 1 and not model.stn.pca
    about = json.loads((tmp_path / "out" / "weights.json").read_text())
    assert (about["loss"], about["cuts"], about["lr"]) == ("height", ["paper"], 1e-3)
    # and on from there
    more = [*small, "--from", str(tmp_path / "out" / "weights.safetensors"), "--lr", "1e-5"]
    train.main([mesh, "-o", str(tmp_path / "more"), "--preset", "paper", *more])
    first, then = (load_file(tmp_path / name / "weights.safetensors") for name in ("out", "more"))
    apart = max(float((first[k] - then[k]).abs().max()) for k in first)
    assert 0 < apart < 1e-4


def test_patches_as_they_are_have_their_points_in_another_order():
    points = torch.rand(3, 50, 3)
    given = garments.GarmentPatches(points, torch.nn.functional.normalize(points, dim=-1))
    drawn = given.drawn(20, torch.Generator().manual_seed(0))
    for x, n in zip(drawn.points, drawn.normals):
        of = [k for k in range(3) if sorted(x.tolist()) == sorted(points[k].tolist())]
        assert len(of) == 1 and not torch.equal(x, points[of[0]])
        assert torch.allclose(n, torch.nn.functional.normalize(x, dim=-1))


@pytest.mark.parametrize("model", ["polyfit", "pointnet", "dgcnn"])
def test_resumed_training_ends_where_an_uninterrupted_one_does(tmp_path, model):
    settings = replace(SMALL, model=model)
    whole = trainer.train(settings, tmp_path / "whole")
    assert trainer.train(settings, tmp_path / "parts", until=3) is None
    assert not (tmp_path / "parts" / "weights.safetensors").exists()
    resumed = trainer.train(settings, tmp_path / "parts", resume=True)
    a, b = load_file(whole), load_file(resumed)
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    short = trainer.train(replace(settings, steps=3), tmp_path / "short")
    assert any(
        (load_file(short)[k] - a[k]).abs().max() > 1e-5 for k in a
    )  # the later steps did something


def test_ctrl_c_leaves_a_checkpoint(tmp_path, monkeypatch):
    step = Training.step

    def interrupted(self):
        if self.done == 4:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(Training, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(SMALL, tmp_path)
    monkeypatch.undo()
    resumed = load_file(trainer.train(SMALL, tmp_path, resume=True))
    whole = load_file(trainer.train(SMALL, tmp_path / "whole"))
    assert all(torch.equal(resumed[k], whole[k]) for k in whole)


@pytest.mark.slow
def test_two_processes_do_what_one_does(tmp_path):
    # a thread of the group that outlives it may abort the ending interpreter
    (tmp_path / "run.py").write_text(
        "import sys\nfrom pathlib import Path\nfrom polyfit import train\ntrain.main()\nleft ="
        " [name for task in Path('/proc/self/task').glob('*') if 'gloo' in (name := (task /"
        " 'comm').read_text())]\nsys.exit(f'threads left: {left}' if left else 0)\n"
    )
    two_ranks(tmp_path / "run.py", *FLAGS, "-o", tmp_path / "two")
    assert json.loads((tmp_path / "two" / "weights.json").read_text())["processes"] == 2
    two, one = (
        load_file(tmp_path / "two" / "weights.safetensors"),
        load_file(trainer.train(SMALL, tmp_path / "one")),
    )
    fresh = trainer.PolyFitTraining(SMALL, None, Processes("cpu")).network.state_dict()
    for k in one:
        assert (two[k] - one[k]).abs().max() <= 1e-4, k
    assert max((one[k] - fresh[k]).abs().max() for k in one) > 1e-3


def test_networks_of_others_train_on_the_same_patches(tmp_path, mesh):
    settings = replace(SMALL, meshes=(mesh,), cuts=(4, 8), families=())
    for model, kind in (("pointnet", PointNet), ("dgcnn", DGCNN)):
        path = trainer.train(replace(settings, model=model, steps=2), tmp_path / model)
        assert kind.load(path, 2)(torch.rand(2, 30, 3)).jet.alpha.shape == (2, 6)
        with pytest.raises(InputError, match=f"weights of {model}, not of polyfit"):
            PolyFit.load(path)
    sets = [load_file(tmp_path / model / "set.safetensors") for model in ("pointnet", "dgcnn")]
    assert all(torch.equal(sets[0][k], sets[1][k]) for k in sets[0])
    path = trainer.train(
        replace(settings, model="atlasnet", charts=3, steps=2, batch=2), tmp_path / "atlasnet"
    )
    assert AtlasNet.load(path).charts == 3


class TestRefused:
    def test_on_the_command_line(self, tmp_path):
        with pytest.raises(InputError, match="^none.obj: no such file"):
            train.main(["none.obj", "-o", str(tmp_path / "new" / "out")])
        assert list(tmp_path.iterdir()) == []

    def test_a_folder_of_the_user_stays(self, tmp_path):
        with pytest.raises(InputError, match="no such file"):
            trainer.train(replace(SMALL, meshes=("none.obj",)), tmp_path)
        assert tmp_path.is_dir()

    @pytest.mark.parametrize(
        "change, message",
        [
            (dict(model="resnet"), "model resnet: choose among polyfit"),
            (dict(families=("sine",)), "families sine: choose among jet"),
            (dict(order=0), "order = 0"),
            (dict(steps=0), "steps = 0; at least 1 is needed"),
            (dict(seed=-1), "seed = -1; at least 0 is needed"),
            (dict(lr=0.0), "lr = 0.0; more than 0 is needed"),
            (dict(reads=300), "reads = 300"),
            (dict(families=()), "nothing to train on"),
            (dict(model="atlasnet"), "nothing to train on: give meshes"),
        ],
    )
    def test_settings(self, change, message):
        with pytest.raises(InputError, match=message):
            replace(SMALL, **change)

    def test_checkpoints_of_other_settings_and_none(self, tmp_path):
        with pytest.raises(InputError, match="nothing to resume"):
            trainer.train(SMALL, tmp_path, resume=True)
        trainer.train(SMALL, tmp_path, until=1)
        with pytest.raises(InputError, match="checkpoint.safetensors: exists; give another -o"):
            trainer.train(SMALL, tmp_path)
        with pytest.raises(InputError, match="checkpoint of other settings"):
            trainer.train(replace(SMALL, seed=1), tmp_path, resume=True)
        (tmp_path / "checkpoint.safetensors").write_bytes(b"half of it")
        with pytest.raises(InputError, match="checkpoint.safetensors: not a file of weights"):
            trainer.train(SMALL, tmp_path, resume=True)

    def test_folders_that_hold_a_result(self, tmp_path):
        trainer.train(replace(SMALL, steps=1), tmp_path)
        before = (tmp_path / "weights.safetensors").read_bytes()
        with pytest.raises(InputError, match="exists; give another -o, or --resume"):
            trainer.train(SMALL, tmp_path)
        assert (tmp_path / "weights.safetensors").read_bytes() == before

    def test_a_loss_that_is_not_finite(self, tmp_path, monkeypatch):
        monkeypatch.setattr(
            trainer.PatchBatches,
            "loss",
            lambda self, network, *_: next(network.parameters()).sum() * torch.nan,
        )
        with pytest.raises(InputError, match="the loss is nan at step 1"):
            trainer.train(SMALL, tmp_path)
        assert not (tmp_path / "weights.safetensors").exists()


def test_cuts_that_are_no_numbers_are_named(capsys):
    with pytest.raises(InputError, match="--cuts: foo: numbers of patches, or paper, are needed"):
        train.main(["tank.obj", "-o", "OUT", "--cuts", "foo"])
