"""``python -m polyfit`` and ``import polyfit`` from outside: what they write, what they refuse,
what they load.
"""

import numpy as np
import pytest
import surfaces
from processes import python, refusal

from polyfit import InputError, read_mesh, write_ply
from polyfit.__main__ import main


def test_the_surface_is_written(tmp_path, capsys):
    V, F = surfaces.tube()
    write_ply(tmp_path / "tube.ply", V, F)
    main(
        [
            str(tmp_path / "tube.ply"),
            "-o",
            str(tmp_path / "out.ply"),
            "--patches",
            "8",
            "--resolution",
            "2",
        ]
    )
    W, G, _ = read_mesh(tmp_path / "out.ply")
    assert len(G) == 4 * len(F)
    assert np.abs(np.hypot(W[:, 0], W[:, 1]) - 0.05).max() < 2e-3
    assert "8 patches, 176 numbers" in capsys.readouterr().out


def test_cuts_and_frames_are_the_paper_s_by_its_preset(tmp_path, capsys):
    V, F = surfaces.tube()
    write_ply(tmp_path / "tube.ply", V, F)
    file = ["-o", str(tmp_path / "out.ply"), "--resolution", "1"]
    said = []
    paper = ["--cuts", "acvd", "--frames", "stn", "--weights", "paper"]
    for flags in ([], paper, ["--preset", "paper"], paper[:4]):
        main([str(tmp_path / "tube.ply"), *flags, "--patches", "12", *file])
        said.append(capsys.readouterr().out)
    assert "transformer" not in said[0]
    assert said[1] == said[2] != said[3] and "the transformer turned the z axis" in said[1]
    main([str(tmp_path / "tube.ply"), "--preset", "paper", *file])
    assert capsys.readouterr().out.startswith("100 patches")
    with pytest.raises(InputError, match="for --frames stn"):
        main([str(tmp_path / "tube.ply"), "--weights", "x.safetensors", *file])


def test_bad_input_ends_in_one_line_and_writes_nothing(tmp_path):
    V, F = surfaces.sheet(n=5)
    write_ply(tmp_path / "sheet.ply", V, F)
    write_ply(tmp_path / "points.ply", V, F[:0])
    (tmp_path / "broken.obj").write_text("v 0 0 0\nv 1 0 zero\n")
    (tmp_path / "folder.ply").mkdir()
    before = sorted(tmp_path.iterdir())
    for message, args in {
        "broken.obj: line 2": ["broken.obj"],
        "points.ply": ["points.ply"],
        "missing.obj: no such file": ["missing.obj"],
        "26 patches; 1 to 25, the number of its vertices": ["sheet.ply", "--patches", "26"],
        "order = 11; the order of a jet is 1 to 10": ["sheet.ply", "--order", "11"],
        "--resolution 0; at least 1 is needed": ["sheet.ply", "--resolution", "0"],
        "3.2e+13 faces of the 32 of": ["sheet.ply", "--resolution", "1000000"],
    }.items():
        with pytest.raises(InputError) as error:
            main([str(tmp_path / args[0]), *args[1:], "-o", str(tmp_path / "out.ply")])
        assert message in str(error.value) and "\n" not in str(error.value)
    for output, message in ("sheet.ply", "is the mesh itself"), ("folder.ply", "is a folder"):
        with pytest.raises(InputError, match=f"{output}: {message}"):
            main([str(tmp_path / "sheet.ply"), "-o", str(tmp_path / output)])
    with pytest.raises(InputError, match="nowhere: no such folder"):
        main([str(tmp_path / "sheet.ply"), "-o", str(tmp_path / "nowhere" / "out.ply")])
    assert sorted(tmp_path.iterdir()) == before


def test_a_mesh_that_may_not_be_what_was_meant_is_told(tmp_path, capsys):
    V, F = surfaces.sheet(n=4)
    flags = ["--resolution", "1", "-o", str(tmp_path / "out.ply")]
    for vertices, faces, said in [
        (V, F, ""),
        (1000 * V, F, "the mesh is "),
        (V[F].reshape(-1, 3), np.arange(F.size).reshape(-1, 3), "the surface is open where "),
    ]:
        write_ply(tmp_path / "mesh.ply", vertices, faces)
        main([str(tmp_path / "mesh.ply"), *flags])
        told = capsys.readouterr().err
        assert told.startswith(f"note: {tmp_path / 'mesh.ply'}: {said}" if said else "")
        assert told.count("\n") == bool(said)


def test_a_process_ends_in_status_2(tmp_path):
    missing = tmp_path / "missing.obj"
    said = refusal(python("-m", "polyfit", missing, "-o", tmp_path / "out.ply"))
    assert "missing.obj: no such file" in said
