"""Bad input as a user meets it: OUT, whole processes, a full disk.

One line names the file, property or value and says what is accepted; the exit status is 2; OUT is
untouched.
"""

import json
import os
import resource
import shutil
import signal
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from processes import python, refusal
from refusals import QUICK, has, line_of, refused

from polyfit.pictures import read_video
from polysft_mi import errors, run
from polysft_mi.pictures import exr
from polysft_mi.surface import meshio


def test_out_that_cannot_be_a_folder(good, tmp_path):
    scene, file = good.folder / "scene.xml", tmp_path / "file"
    file.write_text("mine")
    has(refused(scene, out=file), f"{file}: is a file; OUT must be a folder")
    has(refused(scene, out=file / "out"), f"{file} is not a folder that can be written to")
    assert file.read_text() == "mine"
    with pytest.raises(errors.InputError, match="-o '': "):
        run.main([str(scene), "-o", ""])


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into every folder")
def test_out_in_a_folder_that_cannot_be_written(good, tmp_path):
    tmp_path.chmod(0o555)
    try:
        has(
            refused(good.folder / "scene.xml", out=tmp_path / "out"),
            f"{tmp_path} is not a folder that can be written to",
        )
    finally:
        tmp_path.chmod(0o755)


def test_out_that_holds_something(good, finished, tmp_path):
    scene = good.folder / "scene.xml"
    has(
        refused(scene, out=finished),
        f"{finished}: holds a run; give --overwrite to replace it or --resume",
    )
    (tmp_path / "notes.txt").write_text("mine")
    for flag in ([], ["--overwrite"]):
        has(
            refused(scene, *flag, out=tmp_path),
            f"{tmp_path}: is not empty and holds no run; give an empty or new folder",
        )


def test_nothing_to_resume(good, finished, tmp_path):
    scene = good.folder / "scene.xml"
    has(
        refused(scene, "--resume", out=tmp_path / "out"),
        "out: holds no run to resume; leave out --resume",
    )
    has(
        refused(scene, "--resume", *QUICK, "-D", "k_mi=0.2", out=finished),
        "was run with another scene or other settings",
        "--overwrite",
    )
    shutil.copytree(finished, tmp_path / "broken")
    (tmp_path / "broken" / "scene.xml").unlink()
    has(
        refused(scene, "--resume", *QUICK, out=tmp_path / "broken"),
        "scene.xml: missing; the run cannot be resumed",
    )


def test_files_that_have_changed_since_the_run_began(sheet, tmp_path):
    scene, out = sheet / "scene.xml", tmp_path / "out"
    assert run.main([str(scene), "-o", str(out), *QUICK]) == 0
    for name in ("template.obj", "texture.png", "frames/001.png"):
        before = (sheet / name).read_bytes()
        (sheet / name).write_bytes(before + b"\n")
        has(refused(scene, "--resume", *QUICK, out=out), "have changed since the run began")
        (sheet / name).write_bytes(before)
    assert run.main([str(scene), "-o", str(out), "--resume", *QUICK]) == 0


@pytest.mark.parametrize("keep", [0, 1 / 2])
def test_checkpoint_that_cannot_be_read(good, finished, tmp_path, keep):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    data = (out / "checkpoint.npz").read_bytes()
    (out / "checkpoint.npz").write_bytes(data[: int(keep * len(data))])
    message = refused(good.folder / "scene.xml", "--resume", *QUICK, out=out)
    has(message, f"{out / 'checkpoint.npz'}: not a checkpoint of a run", "--overwrite")


def test_bad_input_spares_the_run_that_would_be_replaced(sheet, finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (sheet / "frames" / "001.png").write_bytes(b"hello")
    has(refused(sheet / "scene.xml", "--overwrite", out=out), "001.png: not a readable image")


def test_overwriting_a_run_by_its_own_scene(finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    assert run.main([str(out / "scene.xml"), "-o", str(out), "-q", "--overwrite"]) == 0
    assert (out / "scene.xml").read_text() == (finished / "scene.xml").read_text()


def test_a_process_ends_with_one_line_and_status_2(good, tmp_path):
    """Mitsuba has a log of its own, which must not be heard."""
    scene, out = good.folder / "scene.xml", tmp_path / "out"
    line = line_of(scene, 'type="$integrator"')
    done = python("-m", "polysft_mi.run", scene, "-o", out, "-D", "integrator=foo")
    has(refusal(done), line, '"foo" not found')
    assert not out.exists()


def test_wrong_names_are_told_before_anything_is_loaded(good, tmp_path):
    """Mitsuba is not even imported for them."""
    code = """
import sys
from polysft_mi import errors, run
for option in ("ordre=4", "order=four"):
    try:
        run.main([*sys.argv[1:], "-D", option])
    except errors.InputError:
        print("mitsuba" in sys.modules)
"""
    done = python("-c", code, good.folder / "scene.xml", "-o", tmp_path / "out")
    assert done.stdout == "False\nFalse\n", done.stderr


def whole(out):
    """Every file that a run left under its own name can be read."""
    for path in filter(Path.is_file, Path(out).rglob("*")):
        if path.suffix == ".npz":
            with np.load(path) as data:
                numbers = [k for k in data if data[k].dtype.kind == "f" and "memory_" not in k]
                assert all(np.isfinite(data[k]).all() for k in numbers)  # memories: NaN is unknown
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".ply":
            meshio.read_template(path)
        elif path.suffix == ".exr":
            exr.read_exr(path)
        elif path.suffix == ".png":
            assert cv2.imread(str(path)) is not None
        elif path.suffix == ".xml":
            assert path.read_text().endswith("</scene>\n")
        elif path.suffix == ".mp4":
            assert next(read_video(path)).ndim == 3
        else:
            assert path.suffix == ".jsonl", path


@pytest.fixture
def small_disk(tmp_path):
    """Mounts a disk of so many KiB, returns its folder."""
    mounted = []

    def mount(kibibytes):
        place = tmp_path / "disk"
        place.mkdir()
        try:
            done = subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"size={kibibytes}k", "tmpfs", place],
                capture_output=True,
                text=True,
            )
        except FileNotFoundError:
            pytest.skip("no mount command")
        if done.returncode:
            pytest.skip(f"a small disk cannot be mounted here: {done.stderr.strip()}")
        mounted.append(place)
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", place], check=True)


@pytest.mark.parametrize("kibibytes", [4, 8, 16, 24, 48, 80, 110])
def test_full_disk(good, small_disk, capsys, kibibytes):
    out = small_disk(kibibytes) / "out"
    ours = signal.getsignal(signal.SIGINT)
    with pytest.raises(SystemExit) as ended:
        errors.cli(lambda: run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK]))
    signal.signal(signal.SIGINT, ours)  # a command's end gives it back to the system
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1, error
    assert error.startswith(f"error: {out}") and "No space left on device" in error
    whole(out)


def test_a_run_that_a_full_disk_stopped_is_resumed(good, small_disk):
    out = small_disk(48) / "out"
    with pytest.raises(OSError, match="No space left"):
        run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK])
    subprocess.run(["mount", "-o", "remount,size=4m", out.parent], check=True)
    assert run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK, "--resume"]) == 0
    assert {"surface.npz", "metrics.json", "comparison.mp4"} <= {p.name for p in out.iterdir()}
    whole(out)


def test_files_that_may_not_grow(good, tmp_path):
    """The same without a mount: a limit on the size of files."""
    out = tmp_path / "out"

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))

    scene = good.folder / "scene.xml"
    done = python("-m", "polysft_mi.run", scene, "-o", out, *QUICK, preexec_fn=limit)
    # Dr.Jit's cache has files too, and says so where it has a kernel that is new to it
    lines = [line for line in done.stderr.splitlines() if not line.startswith("jit_kernel_write()")]
    assert (
        done.returncode == 2
        and len(lines) == 1
        and lines[0].startswith("error: ")
        and not done.stdout
    ), done.stderr
    has(lines[0], str(out), "File too large")
    whole(out)
