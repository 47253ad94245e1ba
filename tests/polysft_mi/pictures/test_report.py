"""The page of a run: what it says is what the run left, and in a browser it shows it."""

import base64
import io
import json
import re
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from browser import BROWSER, needs_browser
from PIL import Image
from scipy.spatial.transform import Rotation

from polyfit.pictures import video
from polysft_mi import report
from polysft_mi.camera import Intrinsics
from polysft_mi.errors import InputError
from polysft_mi.pictures.panels import (
    PEAKS,
    Box,
    at_vertices,
    box_of,
    evenly_spaced,
    heat,
    heat_values,
)
from polysft_mi.pictures.report.page import write_report
from polysft_mi.results.run import Run


@pytest.fixture(scope="module")
def page(finished_run, tmp_path_factory):
    """The report with the truth in it, as a file outside the run's folder."""
    truth, out = finished_run
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert report.main([str(out), "--truth", str(truth.folder), "-o", str(path), "-q"]) == 0
    return path


def data_of(path):
    return json.loads(
        re.search(
            r'<script type="application/json" id="data">(.*?)</script>',
            path.read_text(encoding="utf-8"),
            re.S,
        )[1]
    )


def array(text, dtype):
    return np.frombuffer(base64.b64decode(text), dtype)


def scalar(data, label, shape):
    (found,) = [s for s in data["scalars"] if s["label"] == label]
    raw = array(found["values"], np.uint8).reshape(shape)
    return (
        np.where(raw == 255, np.nan, found["low"] + raw / 254 * (found["high"] - found["low"])),
        found,
    )


def test_a_run_leaves_its_report(finished_run):
    _, out = finished_run
    assert data_of(out / "report.html")["columns"]["frame"] == [0, 1, 2, 3]


def test_page_needs_nothing_else(page):
    text = page.read_text(encoding="utf-8")
    own = text.replace(
        re.search(r"<script>(.{100000,}?)</script>", text, re.S)[1], ""
    )  # without plotly itself
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//|@import|url\(""", own)
    assert "{{" not in own


def test_surface_and_pictures_are_those_of_the_run(finished_run, page):
    run, data = Run.open(finished_run[1]), data_of(page)
    mesh = data["mesh"]
    low, high = np.array(mesh["low"]), np.array(mesh["high"])
    V = low + array(mesh["positions"], "<u2").reshape(run.vertices.shape) / 65535 * (high - low)
    x, y, z = np.moveaxis(run.vertices, -1, 0)
    np.testing.assert_allclose(V, np.stack([x, z, -y], -1), atol=1e-5)
    corners, weights = (
        array(mesh["corners"], "<u4").reshape(-1, 3),
        array(mesh["weights"], "<f4").reshape(-1, 3),
    )
    fine = np.einsum("nk,nkc->nc", weights, V[0][corners])
    F = array(mesh["faces"], "<u4").reshape(-1, 3)
    area = lambda V, F: (
        0.5
        * np.linalg.norm(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), axis=1).sum()
    )
    assert area(fine, F) == pytest.approx(area(V[0], run.faces), rel=1e-6)
    texture = np.asarray(Image.open(run.texture).convert("RGB")).astype(float)
    colours = array(mesh["colours"], np.uint8).reshape(-1, 3)
    uv = np.einsum("nk,nkc->nc", weights, run.uv[corners])
    at = np.clip(
        (np.stack([1 - uv[:, 1], uv[:, 0]], 1) * texture.shape[:2]).astype(int),
        0,
        np.array(texture.shape[:2]) - 1,
    )
    assert (
        np.abs(colours - texture[at[:, 0], at[:, 1]]).mean() < 12
    )  # one end of the texture differs from the other by 150
    target, *others = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data["images"][n][2]))))
        for n in ("target", "render", "error", "residual")
    )
    expected = np.asarray(
        Image.open(finished_run[0].folder / "frames" / "002.png").convert("RGB")
    ).astype(float)
    expected = expected[box_of(run).slices]
    assert np.abs(target.astype(float) - expected).mean() < 6
    assert all(p.shape == target.shape for p in others) and len(data["images"]["error"]) == 4


def test_figures_and_colours(finished_run, page):
    truth, out = finished_run
    run, data = Run.open(out), data_of(page)
    shape = run.vertices.shape[:2]
    true_distance = 1e3 * np.linalg.norm(run.vertices - truth.vertices, axis=2)
    np.testing.assert_allclose(
        data["columns"]["rmse_mm"], np.sqrt((true_distance**2).mean(1)), rtol=1e-4
    )
    assert data["columns"]["psnr_mask"] == [row["psnr_mask"] for row in run.metrics["per_frame"]]
    distance, found = scalar(data, "distance to the truth", shape)
    assert (
        np.abs(distance - np.clip(true_distance, 0, found["high"])).max()
        <= 0.6 * found["high"] / 254
    )
    error, _ = scalar(data, "error", shape)
    assert np.isfinite(error).all() and 0 < error.mean() < 0.1
    residual, _ = scalar(data, "residual", shape)
    assert np.isfinite(residual).all() and 0 < residual.mean() < 0.5
    sigma, found = scalar(data, "sigma", shape)
    known = np.isfinite(run.sigma)
    assert np.array_equal(np.isfinite(sigma), known)
    assert (
        np.abs(sigma - np.clip(1e3 * run.sigma, 0, found["high"]))[known].max()
        <= 0.6 * found["high"] / 254
    )
    assert [label for label, _ in data["cards"]].count("lost frames") == 1


def test_curvature_is_that_of_the_jets(finished_run):
    """On the middle row of the grid, whose rows and columns stay at right angles: half the sum of
    the normal curvatures along both, by differences of the mesh's own edges.
    """
    run = Run.open(finished_run[1])
    p = run.params
    turn = Rotation.from_quat(p["rotation"][-1, 0]).as_matrix()
    up = p["scale"] * p["frame_rotation"][0] @ turn[:, 2]
    height = (p["delta_w"][-1] + p["rest"][:, 0])[:, None]
    jet = run.vertices[-1].astype(float) - height * up  # without relief
    grid = jet.reshape(9, 11, 3)
    row = [grid[4, :-2], grid[4, 1:-1], grid[4, 2:]]
    column = [grid[3, 1:-1], grid[4, 1:-1], grid[5, 1:-1]]
    normal = np.cross(row[2] - row[0], column[2] - column[0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    bent = sum(_turning(*points, normal) for points in (row, column)) / 2
    np.testing.assert_allclose(
        run.mean_curvature()[-1].reshape(9, 11)[4, 1:-1], np.abs(bent), rtol=0.03
    )


def _turning(a, b, c, normal):
    """Normal curvature (N,) [1/m] of the polylines a, b, c (N, 3) [m] at b."""
    before, after = (np.linalg.norm(d, axis=1, keepdims=True) for d in (b - a, c - b))
    return (((c - b) / after - (b - a) / before) / ((before + after) / 2) * normal).sum(1)


def test_error_where_each_vertex_is_seen():
    camera = Intrinsics(100, 100, 20, 20, 40, 40)
    picture = np.zeros((60, 60, 3), np.uint8)  # of a part of the image, at twice its size
    picture[:, 30:, 0] = 255  # a third of the way from black to white, right of the middle
    vertices = np.array(
        [[-0.1, 0, 1], [0.1, 0, 1], [0.5, 0, 1], [0.1, 0, -1], [-0.18, 0, 1], [0, 0.14, 1]]
    )
    values = heat_values(picture, PEAKS["error"])
    error = at_vertices(camera, vertices, values, Box(5, 3, 35, 33))
    wanted = [0, PEAKS["error"] / 3, np.nan, np.nan, np.nan, np.nan]
    np.testing.assert_allclose(error, wanted, atol=1e-6)


def test_heat_is_read_back():
    values = np.linspace(0, 1.5, 60).reshape(6, 10)
    np.testing.assert_allclose(heat_values(heat(values, 1.5), 1.5), values, atol=0.51 * 1.5 / 765)
    assert (heat(np.array([[9.0, np.nan]]), 1.5) == [[[255] * 3, [0] * 3]]).all()


def test_fewer_frames_and_odd_names(finished_run, tmp_path):
    out = tmp_path / "a <b> & 'ü'"
    shutil.copytree(finished_run[1], out)
    about = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps({**about, "command": "</script><!-- x"}))
    write_report(out, frames=2)
    data = data_of(out / "report.html")
    assert (
        data["shown"] == [0, 3]
        and len(data["images"]["target"]) == 2
        and len(data["columns"]["frame"]) == 4
    )
    assert data["command"] == "</script><!-- x" and data["title"] == out.name
    assert "<title>a &lt;b> &amp; 'ü'</title>" in (out / "report.html").read_text(encoding="utf-8")
    assert (
        evenly_spaced(5, 3) == [0, 2, 4]
        and evenly_spaced(2, 9) == [0, 1]
        and evenly_spaced(9, 1) == [0]
    )


def test_pngs_stand_in_for_the_video(finished_run, tmp_path):
    """As a run leaves them where no video can be encoded."""
    out = tmp_path / "run"
    shutil.copytree(finished_run[1], out)
    for k, frame in enumerate(video.read_video(out / "comparison.mp4")):
        Image.fromarray(frame).save(out / "comparison" / f"{k:03d}.png")
    (out / "comparison.mp4").unlink()
    write_report(out)
    assert (
        data_of(out / "report.html")["images"] == data_of(finished_run[1] / "report.html")["images"]
    )
    metrics = json.loads((out / "metrics.json").read_text())
    lost = {"frames_wanted": 9, "lost": {"2": "left the image"}}
    (out / "metrics.json").write_text(json.dumps({**metrics, **lost}))
    write_report(out)
    assert (
        data_of(out / "report.html")["warning"]
        == "Interrupted: 4 of 9 frames. Frame 2: left the image."
    )


def test_refusals_leave_nothing(finished_run, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(finished_run[1], out)
    (out / "report.html").unlink()
    (out / "comparison.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="comparison.mp4: not a readable video"):
        write_report(out)
    (out / "comparison.mp4").unlink()
    with pytest.raises(InputError, match="pictures are needed"):
        write_report(out)
    shutil.copy(finished_run[1] / "comparison.mp4", out)
    with pytest.raises(InputError, match="holds no ground truth"):
        write_report(out, truth=tmp_path)
    with pytest.raises(InputError, match="not a file in a folder"):
        write_report(out, tmp_path / "nowhere" / "a.html")
    with pytest.raises(InputError, match="ends in .html"):
        write_report(out, out / "params.npz")
    with pytest.raises(InputError, match="--frames 0"):
        report.main([str(out), "--frames", "0"])
    assert (
        not (out / "report.html").exists()
        and [p for p in out.iterdir() if "partial" in p.name] == []
    )


# ---- in a browser --------------------------------------------------------------------------------

_WATCH = """<script>
const problems = [];
addEventListener("error", e => problems.push(String(e.message)));
addEventListener("unhandledrejection", e => problems.push(String(e.reason)));
console.error = (...a) => problems.push(a.join(" "));
</script>"""
_ACT = """<img src="/hold" hidden><script>
(async () => {
  const sleep = () => new Promise(done => setTimeout(done, 100)), seen = {};
  const wait = async () => { do await sleep(); while (busy); };  // `busy`: the page still draws
  const note = name => {
    const surface = $("surface").data[0];
    seen[name] = {
      now, target: $("target").src.length, label: $("now").textContent,
      drawn: $("target").naturalWidth, row: document.querySelector("tr.now").rowIndex,
      z: surface.z.reduce((a, b) => a + b, 0), kind: Object.keys(surface).includes("intensity")
    };
  };
  await wait(); note("start");
  STEPS
  const boxes = ["target", "surface"].map(id => $(id).getBoundingClientRect()).map(
    b => [b.top, Math.min(b.bottom, innerHeight), b.left, b.right].map(Math.round));
  const fetched = performance.getEntriesByType("resource").map(r => r.name).filter(
    name => !/^(data|blob):/.test(name));
  const body = JSON.stringify({...seen, problems, boxes, fetched});
  await fetch("/seen", {method: "POST", body});
})();
</script></body>"""
_STEPS = """
  $("time").value = 2; $("time").dispatchEvent(new Event("input")); await wait(); note("slid");
  const key = async (k, name) => {
    document.dispatchEvent(new KeyboardEvent("keydown", {key: k, bubbles: true}));
    await wait(); note(name);
  };
  await key("ArrowRight", "right"); await key("Home", "home"); await key("End", "end");
  [...$("choices").children].find(b => b.textContent === "curvature").click();
  await wait(); note("curvature");
"""


def browse(page, tmp_path, steps):
    """The page opened in a browser, with steps done in it: what it noted, and a screenshot (H, W,
    3) from the page's top. The browser takes it when all of the page has come; a picture in it that
    comes after the steps holds it until then, however slow the machine.
    """
    text = page.read_text(encoding="utf-8").replace("<head>", "<head>" + _WATCH, 1)
    before, _, after = text.rpartition("</body>")
    served = (before + _ACT.replace("STEPS", steps) + after).encode()
    seen, ready = [], threading.Event()

    class Server(BaseHTTPRequestHandler):
        def do_GET(self):
            if self.path == "/hold":
                ready.wait(120)
            self.answer(served if self.path == "/page.html" else b"")

        def do_POST(self):
            seen.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.answer(b"")
            ready.set()

        def answer(self, body):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args):
            pass

    picture = tmp_path / "page.png"
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--no-first-run",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=1300,1500",
        f"--screenshot={picture}",
    ]
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/page.html"
        done = subprocess.run(
            [BROWSER, *flags, address], capture_output=True, text=True, timeout=120
        )
        ready.set()
        server.shutdown()
    assert seen, done.stderr[-2000:]
    return seen[0], np.asarray(Image.open(picture).convert("RGB")).astype(int)


def part(picture, box):
    top, bottom, left, right = box
    return picture[top:bottom, left:right]


@needs_browser
def test_browser_shows_it(page, tmp_path):
    (tmp_path / "still").mkdir(), (tmp_path / "moved").mkdir()
    still, first = browse(page, tmp_path / "still", "")
    seen, last = browse(page, tmp_path / "moved", _STEPS)
    assert seen["problems"] == still["problems"] == []
    assert [name for name in seen["fetched"] if not name.endswith("/hold")] == []
    assert [seen[n]["now"] for n in ("start", "slid", "right", "home", "end")] == [0, 2, 3, 0, 3]
    assert (
        seen["slid"]["label"].startswith("frame 2")
        and seen["slid"]["row"] == 3
        and seen["start"]["drawn"] > 50
    )
    assert seen["slid"]["z"] != seen["start"]["z"] == seen["home"]["z"]
    assert (seen["start"]["kind"], seen["curvature"]["kind"]) == (False, True)
    (before, surface), (after, same) = (
        [part(p, box) for box in seen["boxes"]] for p in (first, last)
    )
    assert np.abs(before - after).max(2).mean() > 5  # the slider changed the picture
    for picture in (surface, same):  # its background and axes are grey
        assert (np.ptp(picture, axis=2) > 20).mean() > 0.1, "the surface in 3D is blank"
    assert (np.abs(surface - same).max(2) > 40).mean() > 0.05
