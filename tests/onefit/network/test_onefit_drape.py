import json

import cv2
import numpy as np
import pytest
import torch
from places import ROOT

import onefit
from onefit import drape, simulate
from onefit.body import AnnyBody
from onefit.draping.output import Outcome
from onefit.network import OneFit, weights
from polyfit.errors import InputError


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    weights.save(path, OneFit(), AnnyBody(), ("shorts",))
    return str(path)


@pytest.fixture(scope="module")
def out(network, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drapes") / "out"
    simulate.main([
        "shorts", "walk", "-o", str(folder), "--weights", network, "--seconds", "0.1", "--size",
        "90", "60", "--spp", "4", "--meshes", "ply", "--shape", "height=0.6", "weight=0.4",
    ])  # fmt: skip
    return folder


def test_arrays_and_figures(out):
    with np.load(out / "drape.npz") as file:
        T, N, _ = file["vertices"].shape
        assert (
            T == 3
            and file["rest"].shape == (N, 3)
            and file["body"].shape[0] == T
            and float(file["fps"]) == 30
        )
        assert (
            file["faces"].max() == N - 1 and file["body_faces"].max() == file["body"].shape[1] - 1
        )
    about = json.loads((out / "figures.json").read_text())
    assert about["garment"] == "shorts" and about["frames"] == T and about["vertices"] == N
    assert about["shape"] == pytest.approx([0.5, 0.5, 0.5, 0.4, 0.6, 0.5])
    assert {"collision", "edge", "area", "energy", "jitter"} <= set(about)
    assert about["verb"] == "simulate" and about["steps"] == 2 and about["material"] == "cotton"
    assert about["collision"] == 0 and about["edge"] < 1.5


def test_animations_hold_the_arrays(out):
    from pxr import Usd, UsdGeom

    with np.load(out / "drape.npz") as file:
        for name, vertices in (("garment", file["vertices"]), ("body", file["body"])):
            stage = Usd.Stage.Open(str(out / f"{name}.usd"))
            assert (
                UsdGeom.GetStageUpAxis(stage) == "Z"
                and UsdGeom.GetStageMetersPerUnit(stage) == 1
                and stage.GetTimeCodesPerSecond() == 30
            )
            points = UsdGeom.Mesh(stage.GetPrimAtPath(f"/{name}/mesh")).GetPointsAttr()
            for t in range(len(vertices)):
                assert np.abs(np.array(points.Get(t)) - vertices[t]).max() < 1e-5
        meshes = sorted((out / "meshes").glob("*.ply"))
        assert len(meshes) == len(file["vertices"])


def test_pictures_show_body_and_garment(out):
    frames = sorted((out / "frames").glob("*.png"))
    assert len(frames) == 3 and (out / "drape.mp4").stat().st_size > 1000
    image = cv2.imread(str(frames[0])).astype(int)
    assert image.shape == (90, 60, 3)
    blue = image[..., 0] - image[..., 2]
    assert 20 < (blue > 40).sum() < 1500  # the shorts
    assert image.std() > 10


def test_what_is_next_names_files_that_are_there(out):
    words = Outcome(out, 3, 9, 1.0, 0.0, {}).next_step().replace(",", "").split()
    named = [word for word in words if word.endswith((".mp4", ".usd"))]
    assert named == [str(out / "drape.mp4"), str(out / "garment.usd"), "body.usd"]
    assert all((out / name).exists() for name in named)


def test_what_is_there_is_not_lost(out, network):
    with pytest.raises(InputError, match="not empty; give another -o, or --overwrite"):
        drape.main(["shorts", "walk", "-o", str(out), "--weights", network])
    with pytest.raises(InputError, match="holds no drape"):
        drape.main(
            ["shorts", "walk", "-o", str(ROOT / "tests"), "--weights", network, "--overwrite"]
        )


def test_overwriting_replaces_a_drape_s_files_and_nothing_else(network, tmp_path):
    out = tmp_path / "out"
    quick = ["--weights", network, "--seconds", "0.1", "--skip", "usd", "render", "-o", str(out)]
    drape.main(["shorts", "tank", "walk", "--meshes", "obj", *quick])
    drape.main(["shorts", "walk", "--meshes", "ply", *quick, "--overwrite"])
    assert {p.name for p in out.iterdir()} == {"drape.npz", "figures.json", "meshes"}
    for name in (
        "notes.txt",
        "photos/1.png",
        "meshes/mine.ply",
        "2_tank/cut.obj",
        "kept/drape.npz",
    ):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("mine")
        with pytest.raises(InputError, match=f"holds {name}, which is not of a drape"):
            drape.main(["shorts", "walk", *quick, "--overwrite"])
        assert (out / name).read_text() == "mine" and (out / "drape.npz").exists()
        (out / name).unlink()
        if not any((out / name).parent.iterdir()):
            (out / name).parent.rmdir()


def test_a_folder_that_cannot_be_written_is_told_before_the_work(tmp_path):
    (tmp_path / "file.obj").write_text("")
    for out, message in (
        (tmp_path / "file.obj" / "sub", "file.obj is not a folder that can be written to"),
        (tmp_path / "file.obj", "file.obj: is a file"),
        ("/proc/x", "-o '/proc/x': /proc is not a folder"),
    ):
        with pytest.raises(InputError, match=message):
            drape.main(["no garment", "no motion", "-o", str(out)])
    assert [p.name for p in tmp_path.iterdir()] == ["file.obj"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            ("shorts", "tango"),
            "motion tango: no such file, and no kind of motion; the kinds are idle, walk",
        ),
        (("tuxedo.obj", "walk"), "tuxedo.obj: no such file"),
        (("tuxedo", "walk"), "garment 'tuxedo': no such template; there are tshirt, dress, tank"),
        (("shorts", "walk", "--vertices", "10"), "--vertices 10: at least 100 are needed"),
        (
            ("shorts", "walk", "--material", "silk"),
            "--material: python -m onefit.simulate takes it",
        ),
        (("shorts", "walk", "--steps", "2"), "--steps: python -m onefit.simulate takes it"),
        (("shorts", "walk", "--shape", "girth=3"), "--shape girth=3: choose among gender, age"),
        (("shorts", "walk", "--shape", "weight=heavy"), "--shape weight=heavy: a number is needed"),
        (("shorts", "walk", "--shape", "weight=0.5", "weight=0.9"), "weight is there twice"),
        (("shorts", "walk", "--up", "z"), "--up: for a garment's file; shorts is a template"),
        (("shorts", "walk", "--shape", "weight=2"), "weight = 2; phenotypes go from 0 to 1"),
        (("shorts", "tank", "walk", "--scale", "0.01"), "--scale: for a garment's file; shorts is"),
        (("shorts", "walk", "--made-for", "T-pose"), "--made-for: for a garment's file"),
        (("shorts", "walk", "--turn", "90"), "--turn: for a garment's file"),
        (("skirt", "walk", "--loose"), "--loose: for a garment's file"),
        (("shorts", "walk", "--fps", "60"), "--fps: for a motion file; walk is generated"),
        (("shorts", "walk", "--motion-up", "y"), "--motion-up: for a motion file"),
        ((str(ROOT / "tests"), "walk"), "tests: is a folder; a garment is an .obj"),
        (("shorts", "walk", "--seed", "-1"), "seed = -1; a whole number, 0 or more"),
        (("shorts", "walk", "--device", "foo"), "device foo: cpu or cuda is needed"),
        (("shorts", "walk", "--device", "cuda:99"), "device cuda:99: this torch sees no such"),
        (("shorts", "walk", "--body", "nobody.npz"), "--body nobody.npz: no such file"),
    ],
)
def test_refused_in_one_line(arguments, message, network, tmp_path):
    with pytest.raises(InputError) as caught:
        drape.main([*arguments, "-o", str(tmp_path / "out"), "--weights", network])
    assert message in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words, hint",
    [
        ("--shape weight=0.7 dress walk", "required: GARMENT, MOTION; --shape takes all words up"),
        ("dress --shape weight=0.7 walk", "required: MOTION; --shape takes all words up"),
        ("--skip render usd dress walk", "'dress' .*; --skip takes all words up to the next flag"),
        ("dress", "required: MOTION; python -m onefit.drape --help lists the options$"),
    ],
)
def test_words_that_a_list_swallowed_are_hinted_at(words, hint, tmp_path):
    with pytest.raises(InputError, match=hint):
        drape.main([*words.split(), "-o", str(tmp_path / "out")])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--steps", "0"), "--steps 0: steps a frame, 1 or more"),
        (("--material", "wool"), "material 'wool': choose among cotton, silk"),
        (("--material", "denim,silk"), "^2 materials for 1 garment; give one for each, in their"),
        (("--no-post",), "--no-post: python -m onefit.drape takes it"),
        (("--post",), "--post: python -m onefit.drape takes it"),
        (("--no-ease",), "--no-ease: python -m onefit.drape takes it"),
        (("--preset", "paper"), "--preset: python -m onefit.drape takes it"),
    ],
)
def test_a_simulation_refuses_what_it_has_not(arguments, message, network, tmp_path):
    out = ["-o", str(tmp_path / "out"), "--weights", network]
    with pytest.raises(InputError, match=message):
        simulate.main(["shorts", "walk", *arguments, *out])
    assert not (tmp_path / "out").exists()


def test_both_verbs_take_the_same_arguments_but_their_own():
    flags = lambda verb: {
        flag for action in verb.parser()._actions for flag in action.option_strings
    }
    shown = lambda verb: verb.parser().format_help()
    own = {"--post", "--no-post", "--ease", "--no-ease", "--preset"}
    assert flags(drape) == flags(simulate) | own
    assert "--no-post" in shown(drape) and "--no-post" not in shown(simulate)
    for flag in ("--material", "--steps"):
        assert flag in shown(simulate) and f"{flag} " not in shown(drape)


def test_the_summary_is_in_lines_that_fit_a_terminal(network, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    drape.main([
        "shorts", "walk", "-o", str(tmp_path / "out"), "--weights", network, "--seconds", "0.1",
        "--skip", "usd", "render",
    ])  # fmt: skip
    said = capsys.readouterr()
    folder, following = said.out.splitlines()
    assert folder == str(tmp_path / "out")
    assert following == f"next: read {tmp_path / 'out' / 'drape.npz'} by numpy.load"
    lines = [line for line in said.err.splitlines() if line.strip()]
    assert [line.partition(":")[0] for line in lines] == ["frames", "speed", "inside the body"]
    assert max(map(len, lines)) < 80


@pytest.mark.parametrize("verb", ["drape", "simulate"])
def test_a_command_makes_what_python_makes(verb, tmp_path):
    words = ["tshirt", "walk", "--seconds", "0.2", "--skip", "usd", "render"]
    garment = onefit.Garment.template("tshirt")
    if verb == "simulate":
        words, garment = [*words, "--vertices", "300"], garment.remeshed(300)
    {"drape": drape, "simulate": simulate}[verb].main([*words, "-o", str(tmp_path / "out")])
    motion = onefit.Motion.generate("walk", seconds=0.2)
    made = getattr(onefit.load(), verb)(garment, motion)
    with np.load(tmp_path / "out" / "drape.npz") as file:
        for name in ("vertices", "body", "root"):
            assert np.abs(file[name] - getattr(made, name).numpy()).max() < 1e-6


def test_what_a_motion_file_does_not_say_is_said_by_flags(network, tmp_path):
    # the advice of the messages is taken word for word
    np.savez(tmp_path / "still.npz", poses=np.zeros((9, 72)), trans=np.zeros((9, 3)))
    arguments = [
        "shorts",
        str(tmp_path / "still.npz"),
        "--weights",
        network,
        "--skip",
        "usd",
        "render",
        "-o",
        str(tmp_path / "out"),
    ]
    for flags, message in (
        ([], "no frame rate .*give it: .* --fps 30$"),
        (["--fps", "60"], "lies down most of the time; give up='y', or --motion-up y"),
    ):
        with pytest.raises(InputError, match=message):
            drape.main([*arguments, *flags])
    drape.main([*arguments, "--fps", "60", "--motion-up", "y"])
    with np.load(tmp_path / "out" / "drape.npz") as file:
        assert len(file["vertices"]) == 5 and file["fps"] == 30  # 8 / 60 s


def test_a_motion_file_is_cut_and_resampled_which_is_told(network, tmp_path, capsys):
    path = str(tmp_path / "still.npz")
    np.savez(path, poses=np.zeros((90, 72)), trans=np.zeros((90, 3)), fps=60)
    words = ["shorts", path, "--weights", network, "--skip", "usd", "render"]
    drape.main([*words, "--seconds", "0.2", "-o", str(tmp_path / "out")])
    with np.load(tmp_path / "out" / "drape.npz") as file:
        assert len(file["vertices"]) == 6 and file["fps"] == 30
    assert f"{path}: 60 frames a second, resampled to 30\n" in capsys.readouterr().err
    for flags, message in (
        (["--seed", "1"], "--seed: for a generated motion; .*still.npz is a file"),
        (["--seconds", "0"], "--seconds 0: more than 0 are needed"),
        (["--seconds", "nan"], "--seconds nan: more than 0 are needed"),
    ):
        with pytest.raises(InputError, match=message):
            drape.main([*words, *flags, "-o", str(tmp_path / "none")])


def test_a_mesh_in_centimetres_with_y_up(network, tmp_path):
    from onefit.garment import Garment
    from polyfit.mesh import write_ply

    shorts = Garment.template("shorts")
    x, y, z = 100 * shorts.vertices.double().numpy().T
    write_ply(tmp_path / "shorts.ply", np.stack([x, z, -y], 1), shorts.faces.numpy())
    arguments = [
        str(tmp_path / "shorts.ply"),
        "walk",
        "--weights",
        network,
        "--seconds",
        "0.1",
        "--skip",
        "usd",
        "render",
    ]
    with pytest.raises(InputError, match="it looks like .*y up"):
        drape.main([*arguments, "-o", str(tmp_path / "wrong")])
    drape.main([*arguments, "-o", str(tmp_path / "right"), "--scale", "0.01", "--up", "y"])
    with np.load(tmp_path / "right" / "drape.npz") as file:
        assert np.abs(file["rest"] - shorts.vertices.numpy()).max() < 1e-3
        assert file["mesh_vertices"].shape[1] == len(shorts.vertices)
        apart = np.linalg.norm(file["mesh_vertices"] - file["vertices"], axis=2)
        assert apart.max() < 1e-3 and (file["mesh_faces"] == file["faces"]).all()
    assert sorted(p.name for p in (tmp_path / "right").iterdir()) == ["drape.npz", "figures.json"]


def test_what_two_frames_do_not_tell_is_null(network, tmp_path):
    words = ["shorts", "walk", "--seconds", "0.05", "--vertices", "300", "--weights", network]
    drape.main([*words, "--skip", "usd", "render", "-o", str(tmp_path / "out")])
    refuse = lambda word: pytest.fail(f"{word} is no JSON")
    text = (tmp_path / "out" / "figures.json").read_text()
    figures = json.loads(text, parse_constant=refuse)
    assert figures["frames"] == 2 and figures["jitter"] is None and figures["edge"] > 0


def test_the_paper_s_preset_is_the_paper_s_network_alone(tmp_path):
    words = "tank walk --seconds 0.2 --preset paper --skip usd render -o".split()
    drape.main([*words, str(tmp_path / "out")])
    with np.load(tmp_path / "out" / "drape.npz") as file:
        made = file["vertices"]
    draper, motion = onefit.load("paper"), onefit.Motion.generate("walk", seconds=0.2)
    assert draper.network.shape["extras"] == []
    alone = draper.drape("tank", motion, post=False, eased=False).vertices.numpy()
    assert np.abs(made - alone).max() < 1e-5
    assert np.abs(made - draper.drape("tank", motion, post=False).vertices.numpy()).max() > 1e-4
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert (figures["post"], figures["eased"]) == (False, False)
