import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from processes import two_ranks
from rich.progress import Progress
from safetensors.torch import load_file

import onefit
from onefit import train
from onefit.objective import Weights
from onefit.training import OneFitTraining, Settings, data_of, loop
from onefit.training.data import LENGTH
from polyfit.errors import InputError
from polyfit.mesh import write_ply
from polyfit.training import Processes


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    """A file in the form of AMASS: arms that swing, knees that bend, half a second at 60 frames a
    second.
    """
    t = np.linspace(0, 1, 31)
    poses = np.zeros((31, 156))
    poses[:, 3 * 16 + 2], poses[:, 3 * 17 + 2] = -0.9 + 0.4 * t, 0.9 - 0.4 * t
    poses[:, 3 * 4], poses[:, 3 * 1] = 0.5 * t, -0.4 * t
    poses[:, 0] = np.pi / 2  # z up
    trans = np.stack([0 * t, -0.3 * t, 0.9 + 0 * t], 1)
    path = tmp_path_factory.mktemp("motions") / "swing.npz"
    np.savez(path, poses=poses, trans=trans, mocap_framerate=60.0, betas=np.zeros(16))
    return str(path)


@pytest.fixture(scope="module")
def small(motion):
    return Settings(
        garments=("shorts",),
        motions=(motion,),
        batch=600,
        epochs=2,
        lr_epochs=1,
        epoch_steps=4,
        shapes=1,
    )


@pytest.fixture(scope="module")
def data(small):
    from onefit.garment import Garment
    from onefit.motion import Motion
    from onefit.training import TrainingData

    return TrainingData(
        [Garment.template("shorts")], motions=[Motion.read(small.motions[0])], shapes=1
    )


def test_windows_are_of_consecutive_frames_at_30_a_second(data):
    windows = data.windows(5, torch.Generator().manual_seed(0))
    assert windows.poses.shape == (5, LENGTH, 24, 3) and windows.translation.shape == (5, LENGTH, 3)
    step = windows.translation.diff(dim=1)[..., 1]
    assert torch.allclose(step, torch.full_like(step, -0.3 / 0.5 / 30), atol=1e-4)
    assert set(windows.number.tolist()) <= {0, 1}
    assert windows.shape[windows.number == 0].abs().sum() == 0


def test_motions_are_read_as_the_flags_say(motion, tmp_path):
    from rich.progress import Progress

    args = ["shorts", "--motions", motion, "--fps", "20", "--motion-up", "z", "--shapes", "1"]
    args = train.parser().parse_args([*args, "-o", str(tmp_path)])
    settings = Settings(
        garments=("shorts",), motions=(motion,), fps=args.fps, motion_up=args.motion_up, shapes=1
    )
    (read,) = data_of(settings, str(tmp_path), Progress()).motions
    assert len(read.poses) == 46  # 31 frames at 20 a second last 1.5 s
    (other,) = data_of(replace(settings, motion_up="y"), str(tmp_path), Progress()).motions
    assert not np.allclose(other.translation, read.translation, atol=1e-3)  # taken at its word


def test_training_lowers_the_loss(small, data):
    training = OneFitTraining(replace(small, epochs=1, epoch_steps=60), data, Processes("cpu"))

    def loss():
        with torch.no_grad():
            return (
                sum(
                    sum(training.loss(torch.Generator().manual_seed(k)).values()).item()
                    for k in range(3)
                )
                / 3
            )

    before = loss()
    for _ in range(25):
        training.step()
    assert loss() < before - 0.005


def test_each_loss_has_a_switch(small, data):
    names = dict(
        k_c="collision",
        k_i="inextensibility",
        k_mi="mesh_inextensibility",
        k_g="gravity",
        k_in="inertia",
    )
    for switch, name in names.items():
        training = OneFitTraining(
            replace(small, objective="paper", weights=Weights(**{switch: 0.0})),
            data,
            Processes("cpu"),
        )
        with torch.no_grad():
            terms = training.loss(torch.Generator().manual_seed(0))
        assert set(terms) == (set(names.values()) | {"boundary"}) - {name}
    training = OneFitTraining(
        replace(small, objective="paper", weights=Weights(k_b=0.0, k_bn=0.0)),
        data,
        Processes("cpu"),
    )
    with torch.no_grad():
        assert "boundary" not in training.loss(torch.Generator().manual_seed(0))


def test_the_objective_of_the_material_has_its_own_terms(small, data):
    energies = {"stretching", "bending", "gravity", "inertia"}
    for off, names in (({}, energies | {"collision"}), (dict(k_c=0.0), energies)):
        training = OneFitTraining(
            replace(small, objective="material", weights=Weights(**off)), data, Processes("cpu")
        )
        with torch.no_grad():
            assert set(training.loss(torch.Generator().manual_seed(0))) == names


def test_without_lessons_the_objective_is_the_paper_s():
    assert Settings().lowered == "paper"
    assert replace(Settings(), teacher="LESSONS").lowered == "material"
    assert Settings(teacher="LESSONS", objective="paper").lowered == "paper"


def test_the_rate_falls_to_a_tenth(small, data):
    training = OneFitTraining(small, data, Processes("cpu"))
    rates = []
    for _ in range(5):
        training.step()
        rates.append(training.optimiser.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3] * 4 + [1e-4])


def test_a_step_that_is_not_finite_is_stepped_over(small, data, monkeypatch, capsys):
    training = OneFitTraining(small, data, Processes("cpu"))
    training.step()
    before = {k: v.clone() for k, v in training.network.state_dict().items()}
    loss = OneFitTraining.loss
    monkeypatch.setattr(
        OneFitTraining,
        "loss",
        lambda self, g: {
            k: v * float("nan") if k == "gravity" else v for k, v in loss(self, g).items()
        },
    )
    figures = training.step()
    assert figures["stepped_over"] == 1 and np.isfinite(figures["loss"])
    assert "step 1: gravity not finite, skipped" in capsys.readouterr().err
    assert all(torch.equal(v, before[k]) for k, v in training.network.state_dict().items())
    monkeypatch.setattr(loop, "BAD_STEPS", 2)
    with pytest.raises(InputError, match="2 steps in a row were not finite"):
        training.step()


@pytest.fixture
def one_thread():
    """Sums of several threads come out in one order or another; on one thread they are the same
    each time.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(count)


@pytest.mark.slow
def test_a_resumed_training_ends_where_an_uninterrupted_one_does(small, tmp_path, one_thread):
    small = replace(small, epoch_steps=2)
    whole = loop.train(small, tmp_path / "whole", command="python -m onefit.train ...")
    assert loop.train(small, tmp_path / "parts", until=3) is None
    resumed = loop.train(small, tmp_path / "parts", resume=True)
    a, b = load_file(whole), load_file(resumed)
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    about = json.loads(whole.with_suffix(".json").read_text())
    assert (
        about["command"] == "python -m onefit.train ..."
        and about["steps"] == 4
        and about["garments"] == ["shorts"]
        and about["weights"]["k_b"] == 5e3
    )
    lines = [
        json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()
    ]
    assert lines[-1]["step"] == 4 and {"loss", "collision", "inertia", "lr"} <= set(lines[-1])
    with pytest.raises(InputError, match="a checkpoint of other settings"):
        loop.train(replace(small, seed=5), tmp_path / "parts", resume=True)
    # and it can be gone on from, with another garment
    tuned = loop.train(
        replace(small, garments=("tank",), start=str(whole), epochs=1, epoch_steps=1),
        tmp_path / "tuned",
    )
    assert onefit.load(tuned).trained.garments == ("tank",)
    first, then = onefit.load(whole).network.state_dict(), onefit.load(tuned).network.state_dict()
    changes = [float((first[k] - then[k]).abs().max()) for k in first]
    assert 0 < max(changes) < 0.01


def test_a_checkpoint_of_another_mesh_of_the_same_name_is_refused(small, tmp_path):
    path, out, shorts = tmp_path / "own.ply", tmp_path / "out", onefit.Garment.template("shorts")
    write_ply(path, shorts.vertices, shorts.faces)
    settings = replace(small, garments=(str(path),))
    assert loop.train(settings, out, until=1) is None
    write_ply(path, shorts.vertices * torch.tensor([1.0, 1.01, 1.0]), shorts.faces)
    with pytest.raises(InputError, match=r"a checkpoint of other settings \(meshes \['own "):
        loop.train(settings, out, resume=True)
    with pytest.raises(InputError, match="own.ply: is a file; a folder is needed"):
        loop.train(settings, path)


def test_the_paper_s_preset_has_the_paper_s_numbers():
    args = train.parser().parse_args(["-o", "OUT", "--preset", "paper", "--k-c", "0"])
    found = {name: getattr(args, name) for name in ("k_b", "k_mi", "k_g", "k_c", "k_i", "k_in")}
    assert found == dict(k_b=5e3, k_mi=2.0, k_g=1.0, k_c=0.0, k_i=0.5, k_in=1.0)
    assert (args.batch, args.lr, args.lr_epochs, args.objective) == (20_000, 1e-3, 10, "paper")
    assert (args.extras, args.frames, args.acvd, args.cuts) == ([], "stn", True, 0)


def test_a_training_of_the_paper_s_network_goes_on_from_its_checkpoint(motion, tmp_path):
    flags = ["tank", "--preset", "paper", "--motions", motion, "--shapes", "1"]
    flags += "--batch 300 --epochs 1 --epoch-steps 2".split()
    folder = tmp_path / "out"
    train.main([*flags, "-o", str(folder)])
    first = load_file(folder / "weights.safetensors")
    # as if the machine had been lost after a step: another goes on from its checkpoint
    settings = train.settings_of(train.parser().parse_args([*flags, "-o", str(folder)]))
    assert loop.train(settings, tmp_path / "lost", until=1) is None
    shutil.copytree(tmp_path / "lost", tmp_path / "elsewhere")
    train.main([*flags, "-o", str(tmp_path / "elsewhere"), "--resume"])
    then = load_file(tmp_path / "elsewhere" / "weights.safetensors")
    apart = [(first[k].float() - then[k].float()).abs().max() for k in first]
    assert first.keys() == then.keys() and max(apart) <= 1  # eight bits; threads sum in any order
    network = onefit.load(folder / "weights.safetensors").network
    assert network.patching == dict(order=4, frames="stn", acvd=True, waistband=False)
    # fine-tuning takes the network as it is
    tuned = ["shorts", *flags[3:], "--from", str(folder / "weights.safetensors")]
    train.main([*tuned, "-o", str(tmp_path / "tuned")])
    assert onefit.load(tmp_path / "tuned" / "weights.safetensors").network.shape == network.shape


@pytest.mark.slow
def test_two_processes_have_the_curve_of_one(small, tmp_path):
    flags = "shorts --batch 600 --epochs 1 --epoch-steps 3 --shapes 1".split()
    flags += ["--motions", small.motions[0]]
    two_ranks("-m", "onefit.train", *flags, "-o", tmp_path / "two")
    train.main([*flags, "-o", str(tmp_path / "one")])
    two, one = (load_file(tmp_path / name / "checkpoint.safetensors") for name in ("two", "one"))
    assert json.loads((tmp_path / "two" / "weights.json").read_text())["processes"] == 2
    curves = [
        [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
        for name in ("two", "one")
    ]
    for a, b in zip(*curves):
        assert {k: a[k] for k in a if k != "seconds"} == pytest.approx(
            {k: b[k] for k in b if k != "seconds"}, rel=1e-3
        )
    # three steps of 1e-3 at most; where a gradient is nearly zero, Adam makes much of its rounding
    apart = torch.cat([(two[k] - one[k]).abs().flatten() for k in one if k.startswith("network.")])
    assert apart.max() < 1e-3 and apart.mean() < 1e-5
    fresh = OneFitTraining(
        replace(small, epochs=1, epoch_steps=3, cuts=1), _Nothing(), Processes("cpu")
    ).network.state_dict()
    moved = torch.cat([(one[f"network.{k}"] - v).abs().flatten() for k, v in fresh.items()])
    assert moved.mean() > 10 * apart.mean()


class _Nothing:
    """Just enough of the data for a fresh network: a cut, whose mesh is not told from others."""

    garments = [(range(100),)]
    standard = type("Body", (), {"joints": range(24)})
    shapes = torch.zeros(1, 6)

    def __len__(self):
        return 1


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(batch=0), "batch = 0; at least 1 is needed"),
        (dict(order=1), "order = 1"),
        (dict(lr=0.0), "lr = 0.0; more than 0 is needed"),
        (dict(epoch_steps=-1), "epoch_steps = -1"),
        (dict(seed=-1), "seed = -1; at least 0 is needed"),
        (dict(objective="beauty"), "objective 'beauty': choose material or paper"),
        (dict(extras=("wings",)), "extras wings: choose among drift"),
        (dict(frames="lda"), "frames 'lda': choose pca or stn"),
        (dict(material="tin"), "material 'tin': choose among"),
    ],
)
def test_settings_are_checked(change, message):
    with pytest.raises(InputError, match=message):
        Settings(**change)


def test_a_wrong_name_is_told(tmp_path):
    with pytest.raises(InputError, match="^tuxedo.obj: no such file"):
        train.main(["tuxedo.obj", "-o", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_garments_in_other_units_are_read_as_the_flags_say(small, tmp_path):
    shorts, path = onefit.Garment.template("shorts"), tmp_path / "mine.ply"
    write_ply(path, 100 * shorts.vertices.numpy(), shorts.faces.numpy())
    with pytest.raises(InputError, match="looks like centimetres: .* or --scale 0.01"):
        train.main([str(path), "-o", str(tmp_path / "no")])
    with pytest.raises(InputError, match="--up: for a garment's file; tank is a template"):
        train.main(["tank", "-o", str(tmp_path / "no"), "--up", "y"])
    mine = replace(small, garments=(str(path),), read=dict(scale=0.01))
    read = data_of(mine, tmp_path, Progress(disable=True)).garments[0][0].garment
    assert torch.allclose(read.vertices, shorts.vertices, atol=1e-5)
