"""Draws docs/layout.png: the packages of the code, and who imports whom, read from the source.

python docs/layout.py
"""

import argparse
import ast
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
PACKAGES = {"polysft_mi": "#dbe9f6", "polyfit": "#fbe3c8", "onefit": "#dff0d8"}
# In the order of the data's way: what each makes of what
WAY = {
    "polysft_mi": {
        "capture": "video and photo → a scene's folder",
        "poses": "image → rigid pose of a template",
        "body": "motion → maps that carry a garment",
        "scene": "scene file → experiment",
        "surface": "mesh → template; unknowns → vertices",
        "render": "vertices → image, with gradients",
        "images": "frames → how well a surface explains them",
        "objective": "unknowns → cost and its derivatives",
        "solvers": "objective, start → where it is least",
        "tracker": "frames → unknowns, one after another",
        "results": "unknowns → files and figures",
        "pictures": "a run → pictures, video, report, viewer",
        "batches": "scenes → many runs, one table",
    },
    "polyfit": {
        "mesh": "files → checked triangles",
        "jets": "points → frame and jet",
        "patches": "mesh → patches → one surface",
        "network": "points → frame and jet, by weights",
        "baselines": "others' networks, to compare with",
        "training": "surfaces → weights",
        "animation": "moving mesh → USD, glTF, OBJ, PLY",
        "pictures": "meshes → pictures and videos",
    },
    "onefit": {
        "body": "shape and pose → skinned body",
        "motion": "file or kind → poses over time",
        "contact": "cloth and body → pushes and planes",
        "garment": "mesh → garment, bound and in patches",
        "network": "patches and motion → deformations",
        "objective": "a drape → losses and measures",
        "physics": "mesh, material, body → steps of cloth",
        "training": "garments and motions → weights",
        "draping": "garment, body, motion → a drape",
        "baking": "drapes → bones and shapes for games",
    },
}


def rooms(package):
    """The packages in a package, in the order of the data's way."""
    found = {p.parent.name for p in (ROOT / package).glob("*/__init__.py")}
    order = [name for name in WAY[package] if name in found]
    return order + sorted(found - set(order))


def imports():
    """Pairs ((package, room), (package, room)): the first imports the second."""
    known = {(p, r) for p in PACKAGES for r in rooms(p)}
    found = set()
    for package, room in known:
        for path in (ROOT / package / room).rglob("*.py"):
            here = path.relative_to(ROOT).with_suffix("").parts
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                for other in _named(node, here):
                    if other in known and other != (package, room):
                        found.add(((package, room), other))
    return found


def _named(node, here):
    """The (package, room) of each thing that an import statement names."""
    if isinstance(node, ast.Import):
        names = [alias.name.split(".") for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        base = list(here[: len(here) - node.level]) if node.level else []
        base += (node.module or "").split(".") if node.module else []
        names = [[*base, alias.name] for alias in node.names]
    else:
        return []
    return [tuple(name[:2]) for name in names if len(name) > 1]


def needed(edges):
    """The edges without those that a longer way implies."""
    after = {}
    for first, second in edges:
        after.setdefault(first, set()).add(second)

    def reach(node):
        return {node}.union(*(reach(other) for other in after.get(node, ())))

    return {
        (first, second)
        for first, second in edges
        if not any(second in reach(other) for other in after[first] - {second})
    }


def draw(path):
    """A column a package, its rooms from top to bottom; an arrow points from what is imported to
    what imports it, red from package to package."""
    width, height, at = 0.74, 0.62, {}
    for column, package in enumerate(PACKAGES):
        names = rooms(package)
        for row, room in enumerate(names):
            at[package, room] = (column, -row * 8 / max(len(names) - 1, 1))
    figure = Figure(figsize=(12, 7.6), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    for first, second in sorted(needed(imports())):
        (x0, y0), (x1, y1) = at[second], at[first]
        if x0 == x1:
            ends = (x0 + width / 2, y0), (x1 + width / 2, y1)
            colour, bend = "#667788", -0.4 if y1 < y0 else 0.4
        else:
            side = 1 if x1 > x0 else -1
            ends = (x0 + side * width / 2, y0), (x1 - side * width / 2, y1)
            colour, bend = "#c4572e", 0.0
        style = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
        style["connectionstyle"] = f"arc3,rad={bend}"
        axes.annotate("", ends[1], ends[0], arrowprops=style, zorder=0.5)  # below the boxes
    for (package, room), (x, y) in at.items():
        style = {"boxstyle": "round,pad=0,rounding_size=0.06", "fc": PACKAGES[package]}
        corner = (x - width / 2, y - height / 2)
        axes.add_patch(FancyBboxPatch(corner, width, height, ec="#555555", **style))
        axes.text(x, y + 0.13, room, ha="center", va="center", fontsize=12, weight="bold")
        text = WAY[package].get(room, "")
        axes.text(x, y - 0.15, text, ha="center", va="center", fontsize=8)
    for column, package in enumerate(PACKAGES):
        axes.text(column, 0.6, package, ha="center", fontsize=14, weight="bold")
    axes.set_xlim(-0.45, 2.72), axes.set_ylim(-8.5, 1.1)
    axes.axis("off")
    figure.savefig(path, facecolor="white")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    draw(ROOT / "docs" / "layout.png")
    for first, second in sorted(imports()):
        print(".".join(first), "imports", ".".join(second))
