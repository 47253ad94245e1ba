"""The architecture: the ways of imports, and the public names.

Imports are read from the source, those inside functions too: a circle stays a circle where it is
imported late. ``from package import Name`` counts as an import of the file that has the name.
"""

import ast
import collections
import functools
import importlib
import re

import pytest
from places import ROOT

PACKAGES = ("polyfit", "onefit", "polysft_mi")  # each may import those before it, no other
# What is not in order yet, by the name of the test. An entry may be removed, never added.
NOT_YET = {
    "docstrings": set(),
    "circles of files": set(),
    "circles of packages": set(),
    "private names": set(),
    "imports past a package": {
        "onefit.body.kernels",
        "onefit.body.quietwarp",
        "onefit.garment.sewing.cuts",
        "onefit.garment.sewing.loose",
        "onefit.garment.sewing.patterns",
        "onefit.garment.sewing.templates",
        "onefit.network.weights",
        "polysft_mi.images.gather",
        "polysft_mi.images.light",
        "polysft_mi.results.comparison",
        "polysft_mi.results.evaluation",
        "polysft_mi.scene.kinect_paper",
        "polysft_mi.surface.meshio",
        "polysft_mi.surface.template",
    },
}


def sources(*folders):
    """The Python files below folders of the repository that git would keep."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if not {"__pycache__", "build"} & set(path.parts):
                yield path


def text_of(path):
    return path.read_text(encoding="utf-8")


def name_of(path):
    """polysft_mi/render/raster.py -> polysft_mi.render.raster"""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def tree_of(path):
    return ast.parse(text_of(path))


@functools.cache
def modules():
    """Every module of the packages, by its name: its file."""
    return {name_of(path): path for path in sources(*PACKAGES)}


@functools.cache
def lazy_names(module):
    """The names that a package's ``__init__`` loads on use: name to module."""
    path, found = modules()[module], {}
    for node in ast.walk(tree_of(path)):
        for keyword in getattr(node, "keywords", []) if isinstance(node, ast.Call) else []:
            if keyword.arg == "submod_attrs":
                for where, names in ast.literal_eval(keyword.value).items():
                    found |= dict.fromkeys(names, f"{module}.{where}")
            if keyword.arg == "handed_on":  # of other packages
                for where, names in ast.literal_eval(keyword.value).items():
                    found |= dict.fromkeys(names, where)
        if isinstance(node, ast.ImportFrom) and path.name == "__init__.py":
            where = absolute(node, module, path)
            found |= {alias.asname or alias.name: where for alias in node.names}
    return found


def absolute(node, module, path):
    """The module that ``from X import ...`` names."""
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    parts = parts[: len(parts) - node.level + (path.name == "__init__.py")]
    return ".".join([*parts, *([node.module] if node.module else [])])


@functools.cache
def imports(module):
    """(module, name or None) of everything of ours that a module imports, wherever in it."""
    path, found = modules()[module], set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {(alias.name, None) for alias in node.names if alias.name in modules()}
        elif isinstance(node, ast.ImportFrom):
            where = absolute(node, module, path)
            for alias in node.names:
                if f"{where}.{alias.name}" in modules():
                    found.add((f"{where}.{alias.name}", None))
                elif where in modules():
                    found.add((home(where, alias.name), alias.name))
    return found - {(module, None)}


def named(path):
    """The modules that a file's import statements name, wherever in it; no relative ones."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module


def home(module, name):
    """The module that has ``name``, where a package's ``__init__`` only hands it on."""
    while name in lazy_names(module) and lazy_names(module)[name] in modules():
        module = lazy_names(module)[name]
    return module


def room_of(module):
    """polysft_mi.render.raster -> polysft_mi.render; a file on the top level is its own room."""
    return ".".join(module.split(".")[:2])


def circles(edges):
    """The sets of nodes that reach each other (Tarjan's strongly connected components)."""
    order, low, stack, found = {}, {}, [], []

    def visit(node):
        order[node] = low[node] = len(order)
        stack.append(node)
        for other in sorted(edges.get(node, ())):
            if other not in order:
                visit(other)
            if other in stack:
                low[node] = min(low[node], low[other])
        if low[node] == order[node]:
            found.append(set(stack[stack.index(node) :]))
            del stack[stack.index(node) :]

    for node in sorted(edges):
        if node not in order:
            visit(node)
    return [c for c in found if len(c) > 1]


def assert_only_known(kind, found):
    """Nothing is wrong but what is known to be."""
    assert sorted(set(found) - NOT_YET[kind]) == []


def test_no_circle_of_files():
    edges = {m: {other for other, _ in imports(m)} for m in modules()}
    assert_only_known("circles of files", set().union(*circles(edges)))


def test_no_circle_of_packages():
    edges = {}
    for module in modules():
        near = edges.setdefault(room_of(module), set())
        near |= {room_of(other) for other, _ in imports(module)} - {room_of(module)}
    assert_only_known("circles of packages", set().union(*circles(edges)))


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_depend_one_way(package):
    """PolyFit on neither of the others, OneFit on PolyFit alone: in functions and in tests, too."""
    above = PACKAGES[PACKAGES.index(package) + 1 :]
    taken = {
        f"{path.relative_to(ROOT)} {name}"
        for path in sources(package, f"tests/{package}")
        for name in named(path)
        if name.partition(".")[0] in above
    }
    assert taken == set()


def test_an_import_in_a_function_is_named(tmp_path):
    path = tmp_path / "late.py"
    path.write_text("def f():\n    import a.b as c\n    from d import e\n    from . import g\n")
    assert set(named(path)) == {"a.b", "d"}


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_imports_are_those_of_the_file_that_has_the_name():
    assert ("polysft_mi.results.run", "Run") in imports("polysft_mi.export")
    assert home("polysft_mi", "Run") == "polysft_mi.results.run"
    assert home("polysft_mi", "set_variant") == "polyfit.backend"
    inside_a_function = ("polysft_mi.results.outputs", None)
    assert inside_a_function in imports("polysft_mi.run")


def test_packages_take_no_private_names_of_each_other():
    taken = set()
    for module in modules():
        for other, name in imports(module):
            private = (name or "").startswith("_") and not (name or "").startswith("__")
            if other != module and private:
                taken.add(f"{module} {name}")
    assert_only_known("private names", taken)


def test_packages_import_each_other_by_their_names():
    """What a package's ``__init__`` hands on; few files are asked by others themselves."""
    past = set()
    for name, path in modules().items():
        for node in ast.walk(tree_of(path)):
            where = absolute(node, name, path) if isinstance(node, ast.ImportFrom) else ""
            if where in modules() and where.count(".") > 1 and room_of(where) != room_of(name):
                past.add(where)
    assert_only_known("imports past a package", past)


def test_what_one_file_alone_uses_begins_with_an_underscore():
    """Functions and numbers; classes may be what a public function returns."""
    texts = [text_of(p) for p in sources(*PACKAGES, "tests", "benchmarks", "docs", "examples")]
    texts += [
        text_of(p) for p in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("*.toml")]
    ]
    count = collections.Counter(word for text in texts for word in set(re.findall(r"\w+", text)))
    alone = set()
    for module, path in modules().items():
        names = [n.name for n in tree_of(path).body if isinstance(n, ast.FunctionDef)]
        for name in [*names, *constants(path)]:
            if not name.startswith("_") and count[name] < 2:
                alone.add(f"{module}.{name}")
    assert_only_known("private names", alone)


def test_every_package_says_what_it_is_for():
    silent = {
        name
        for name, path in modules().items()
        if path.name == "__init__.py" and not ast.get_docstring(tree_of(path))
    }
    assert_only_known("docstrings", silent)


def constants(path):
    """The names in capitals that a module assigns on its top level."""
    for node in tree_of(path).body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
        for target in targets:
            for name in ast.walk(target):
                if isinstance(name, ast.Name) and re.fullmatch(r"_*[A-Z][A-Z0-9_]*", name.id):
                    yield name.id


@pytest.mark.parametrize("package", PACKAGES)
def test_the_public_names_stand_in_the_docs(package):
    part = text_of(ROOT / "docs" / "api.md").partition(f"## {package}:")[2].partition("\n## ")[0]
    listed = re.findall(r"^\| `(\w+)` \|", part, re.M)
    assert sorted(listed) == sorted(importlib.import_module(package).__all__)


def test_the_public_names_exist():
    for package in map(importlib.import_module, PACKAGES):
        assert [n for n in package.__all__ if not hasattr(package, n)] == []


def test_all_modules_are_looked_at():
    assert set(PACKAGES) < set(modules()) and len(modules()) > 100
