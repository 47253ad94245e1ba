"""What the documentation says about files, commands, settings and plugins is so."""

import contextlib
import importlib
import importlib.util
import re

import numpy as np
import pytest
from places import ROOT
from processes import python
from scripts import load

from polysft_mi.objective.problem import Problem
from polysft_mi.prepare import parser as prepare_parser
from polysft_mi.scene import experiment as scene
from polysft_mi.scene import plugins, rules, settings

PAGES = [
    p
    for p in [
        ROOT / "README.md",
        ROOT / "scenes" / "README.md",
        *sorted((ROOT / "docs").glob("*.md")),
    ]
    if p.exists()
]
SCENE = (ROOT / "docs" / "scene.md").read_text(encoding="utf-8")
FOLDERS = "polysft_mi|polyfit|onefit|scenes|tests|docs|benchmarks|blender"


WRITTEN = "\n".join(
    path.read_text(encoding="utf-8")
    for folder in (*FOLDERS.split("|"), "examples")
    for kind in ("py", "xml", "ipynb")
    for path in (ROOT / folder).rglob(f"*.{kind}")
)


def _resolves(name):
    """Whether ``name`` is a module, or an attribute of one."""
    with contextlib.suppress(ImportError):
        return bool(importlib.import_module(name))
    module, _, attribute = name.rpartition(".")
    return hasattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
class TestPage:
    def test_files_that_it_names_are_there(self, page):
        named = set(
            re.findall(rf"(?<![\w/$.])((?:{FOLDERS})/[\w./-]*\w)", page.read_text(encoding="utf-8"))
        )
        assert [n for n in sorted(named) if not (ROOT / n).exists()] == []

    def test_modules_and_names_that_it_names_are_there(self, page):
        text = page.read_text(encoding="utf-8")
        commands = set(re.findall(r"python -m ([\w.]+)", text)) - {"pytest", "pip", "venv"}
        assert [m for m in sorted(commands) if importlib.util.find_spec(m) is None] == []
        for name in re.findall(r"`((?:polysft_mi|polyfit|onefit)\.[\w.]+)", text):
            assert _resolves(name), name

    def test_words_of_the_code_that_it_names_are_in_the_code(self, page):
        named = re.findall(r"`([A-Za-z]\w*_\w+)`", page.read_text(encoding="utf-8"))
        assert [w for w in sorted(set(named)) if not re.search(rf"\b{w}\b", WRITTEN)] == []

    def test_links_lead_somewhere(self, page):
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            if re.match(r"[a-z]+:", link):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            assert target.exists(), link
            if anchor:
                headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.M)
                assert anchor in [
                    re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings
                ], link


def test_table_of_settings_is_the_generated_one():
    shown = re.search(r"<!-- settings -->\n(.*?)\n<!-- /settings -->", SCENE, re.S)
    assert shown[1] == settings.table()


def test_table_of_the_trackers_rules_is_the_generated_one():
    text = (ROOT / "docs" / "tracker.md").read_text(encoding="utf-8")
    assert re.search(r"<!-- rules -->\n(.*?)\n<!-- /rules -->", text, re.S)[1] == rules.table()


def test_every_plugin_and_parameter_is_described():
    parts = dict(re.findall(r"^### (\w+)\n(.*?)(?=^##)", SCENE, re.M | re.S))
    registered = {
        "polysft": plugins.PolySfT,
        "raster": plugins.RasterIntegrator,
        "pinhole": plugins.PinholeSensor,
        "varol_template": plugins._varol_template,
    }
    assert sorted(parts) == sorted(registered)
    for name, plugin in registered.items():
        documented = re.findall(r"^\s*\* - ([\w, ]+)$", plugin.__doc__, re.M)
        for parameter in ", ".join(documented).split(", ") if documented else []:
            assert f"`{parameter}`" in parts[name], (name, parameter)
        described = re.findall(
            r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]+)\|", parts[name], re.M))
        )
        assert set(described) <= set(", ".join(documented).split(", ")), name


def test_example_scene_runs(tmp_path):
    (tmp_path / "example.xml").write_text(re.search(r"```xml\n(<scene.*?)```", SCENE, re.S)[1])
    experiment = scene.load(
        tmp_path / "example.xml", {"data": str(ROOT / "scenes" / "demo"), "last": "0"}
    )
    sequence = experiment.sequence()
    problem = Problem(experiment, sequence)
    assert experiment.settings == settings.Settings(last=0)
    _, alpha = problem.placed.image(problem.patch.vertices(problem.patch.rest()))
    mask = sequence.mask(0)
    assert np.abs(np.array(alpha).reshape(mask.shape) - mask).mean() < 0.1 * mask.mean()


def test_example_of_the_rasteriser_ends_where_its_page_says():
    page = (ROOT / "docs" / "raster.md").read_text(encoding="utf-8")
    done = python("-c", re.search(r"```python\n(.*?)```", page, re.S)[1])
    assert done.returncode == 0, done.stderr
    found = [float(x) for x in re.findall(r"-?\d+\.?[\de-]*", done.stdout)[:3]]
    np.testing.assert_allclose(found, [0.3, -0.2, 0], atol=0.01)


def test_order_of_the_coefficients():
    from polyfit.jets import exponents

    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    power = {"": 1, "²": 2, "³": 3, "⁴": 4}
    shown = {}
    for index, monomial in re.findall(r"\| (\d+): ([1uv²³⁴]+) (?=\|)", text.replace("|", "| |")):
        e = {name: power[p] for name, p in re.findall(r"([uv])([²³⁴]?)", monomial)}
        shown[int(index)] = (e.get("u", 0), e.get("v", 0))
    assert [shown[k] for k in range(15)] == [tuple(e) for e in exponents(4).tolist()]


def test_files_of_a_run_are_described():
    from polysft_mi.results import folder

    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    assert [n for n in folder.FILES if f"`{n}`" not in text] == []
    assert [n for n in folder.FOLDERS if f"`{n}/NNN" not in text] == []


def test_options_of_the_command_are_described():
    from polysft_mi import run

    options = [
        o
        for action in run.parser()._actions
        for o in action.option_strings
        if o not in ("-h", "--help", "-o", "--output")
    ]
    assert [o for o in options if f"`{o}" not in SCENE] == []


def test_pages_build_without_a_warning(tmp_path):
    options = "-W --keep-going -q -b html".split()
    done = python("-m", "sphinx", *options, ROOT / "docs", tmp_path / "html")
    assert done.returncode == 0, done.stderr
    index = (tmp_path / "html" / "index.html").read_text(encoding="utf-8")
    assert [
        p.stem
        for p in (ROOT / "docs").glob("*.md")
        if p.stem != "index" and f'href="{p.stem}.html"' not in index
    ] == []


def test_options_of_prepare_are_described():
    text = (ROOT / "docs" / "prepare.md").read_text(encoding="utf-8")
    known = ("-h", "--help", "-o", "--output", "--quiet")
    options = [
        o for action in prepare_parser()._actions for o in action.option_strings if o not in known
    ]
    assert [
        o for o in options if f"`{o}" not in text and f"[{o} " not in text and f"| {o} " not in text
    ] == []


def test_commands_of_the_tutorial_are_those_that_its_pictures_come_from():
    tutorial = load("docs/tutorial.py")
    lines = tutorial.commands()
    assert [words[2] for words in lines] == ["polysft_mi.prepare", "polysft_mi.run"]
    arguments = prepare_parser().parse_args(lines[0][3:])
    assert (arguments.folder, arguments.texture) == (
        f"{tutorial.OUT}/clip.mp4",
        f"{tutorial.OUT}/photo.jpg",
    )
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    assert [
        name
        for name, _ in tutorial.PICTURES.values()
        if f"({name})" not in text or not (ROOT / "docs" / name).exists()
    ] == []


def test_the_picture_of_the_code_has_every_package():
    layout = load("docs/layout.py")
    for package in layout.PACKAGES:
        assert sorted(layout.WAY[package]) == sorted(layout.rooms(package))
    found = {(first, second) for (_, first), (_, second) in layout.imports()}
    assert {("capture", "scene"), ("patches", "jets"), ("surface", "jets")} <= found
    assert layout.needed({(2, 1), (3, 2), (3, 1)}) == {(2, 1), (3, 2)}
