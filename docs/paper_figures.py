"""The figures of docs/paper.md: functions of what the benchmarks wrote to a table or a line, ""
where they wrote nothing.
"""

GARMENTS = {
    "tshirt": "T-shirt", "dress": "dress", "tank": "tank", "long_sleeve_top": "top",
    "shorts": "shorts", "pants": "pants", "trousers": "pants",
}  # fmt: skip
CHAMFER = {  # the paper's, x 1e3
    "PolyFit": (0.229, 0.168, 0.268, 0.092, 0.372, 0.237),
    "AtlasNet, 5": (0.531, 1.039, 0.939, 0.481, 1.508, 0.963),
    "AtlasNet, 25": (0.490, 1.060, 0.942, 0.420, 1.471, 0.992),
    "AtlasNet, 125": (0.531, 1.111, 1.005, 0.490, 1.547, 0.858),
}
SIX = ("tshirt", "dress", "tank", "long_sleeve_top", "shorts", "pants")
COLLISIONS = {  # epsilon_c in per cent
    "dress": (0.330, 0.840, 2.834, 10.033, 6.271, 2.389),
    "six": (0.422, 0.756, 0.481, 1.592, 1.749, 1.194),
}
JUMPSUIT = {"six": 2.397, "jumpsuit-tuned": 1.982, "jumpsuit": 1.845}
LOSSES = {  # epsilon_e, epsilon_a, epsilon_c
    "all losses": (7.828, 13.020, 0.227),
    "no mesh inextensibility": (13.175, 24.011, 0.263),
    "no inextensibility": (7.739, 12.760, 1.641),
    "no collision": (8.004, 13.373, 0.387),
}
BACKBONES = {
    "PolyFit": "0.0201 / 5.27°, 0.048 ms",
    "PointNet": "0.0309 / 6.94°, 0.075 ms",
    "DGCNN": "0.0290 / 6.41°, 0.063 ms",
}
FAMILIES = {
    "Gaussians only": "0.0248 / 5.49°",
    "4 families": "0.0239 / 5.42°",
    "4 families + garment patches": "0.0201 / 5.32°",
}
SHEETS = ("flag", "bend", "paper", "curtain", "corner")


def table(head, rows):
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join(lines)


def both(found):
    return f"{found['height']:.4f} / {found['angle']:.1f}°"


def ways(data):
    found = data["polyfit_reconstruction"].get("ways")
    if not found:
        return ""
    names = list(dict.fromkeys(row["way"] for row in found))
    rms = {(row["garment"], row["way"]): row["rms_mm"] for row in found}
    garments = dict.fromkeys(row["garment"] for row in found)
    rows = [(GARMENTS[g], *(f"{rms[g, way]:.3f}" for way in names)) for g in garments]
    return table(("RMS from the mesh, mm", *names), rows)


def turned(data):
    rows = [r for r in data["polyfit_reconstruction"].get("ways", ()) if r["garment"] == "tank"]
    by = {row["way"]: row for row in rows}
    if not by:
        return ""
    pca, stn = by["ours"], by["ours, transformer"]
    return (
        f"Of the tank's {stn['patches']} patches the transformer turns the z axis of"
        f" {stn['turned']}; RMS {pca['rms_mm']:.4f} to {stn['rms_mm']:.4f} mm."
    )


def polyfit_training(data):
    found = data["polyfit_accuracy"].get("trained", {})
    if not found:
        return ""
    rows = [("paper", "", "120", "")]
    for name, about in found.items():
        if name in ("main", "paper"):
            way = "ours" if name == "main" else "by the preset"
            rows.append((way, about["steps"], f"{about['minutes']:.0f}", about["machine"]))
    return table(("training", "steps", "minutes", "machine"), rows)


def chamfer(data):
    found = {r["garment"]: r for r in data["polyfit_reconstruction"].get("paper", ())}
    if not found:
        return ""
    cells = lambda values: [f"{v:.3f}" if v is not None else "" for v in values]
    rows = []
    for name, values in CHAMFER.items():
        rows.append((name, "paper", *cells(values)))
        if name == "PolyFit":
            own = [found[g]["chamfer"] if g in found else None for g in SIX]
            floor = [found[g]["floor"] if g in found else None for g in SIX]
            rows += [(name, "ours", *cells(own)), ("floor", "ours", *cells(floor))]
            continue
        trained = data["polyfit_accuracy"].get("atlasnet", {}).get(name.split(", ")[1], {})
        made = {path.split("/")[-1].split(".")[0]: value for path, value in trained.items()}
        if made:
            rows.append((name, "ours", *cells([made.get(g) for g in SIX])))
    return table(("", "", *(GARMENTS[g] for g in SIX)), rows)


def _sft(data, sequence, method):
    whole = lambda r: not any(v for v in r["setup"].values())
    found = [r for r in data["sft"].get("results", ()) if whole(r) and "figures" in r]
    found = [r for r in found if (r["sequence"], r["method"]) == (sequence, method)]
    return found[0] if found else None


KINECT = {  # method to its name in tables
    "adam": "preset",
    "adam-reweighted": "its losses by other weights, with masks",
    "gauss-newton": "default",
}


def kinect_paper(data):
    rows = [("paper", "2.59", "", "", "")]
    for method, name in KINECT.items():
        if r := _sft(data, "kinect_paper", method):
            f = r["figures"]
            values = (f"{f[k]:.2f}" for k in ("depth_rmse_allpix_mm", "depth_rmse_mm"))
            rows.append((name, *values, r["lost"], f"{r['seconds_a_frame']:.1f}"))
    head = ("solver", "over all pixels, mm", "on the surface, mm", "frames lost", "s a frame")
    return table(head, rows)


def readings(data):
    found = data["readings"]
    if not found:
        return ""
    frames = next(iter(found.values()))
    rows = [(name, *(f"{row[k][1]:.2f}" for k in frames)) for name, row in found.items()]
    left = table(("loss left after 35 % of the way to frame", *frames), rows)
    return f"{left}\n\n{stretch(data)}".rstrip()


def stretch(data):
    tables = []
    for name, found in data["stretch"].items():
        first, last = map(int, name.split(" to "))
        frames = range(first, last + 1)[:: max(1, (last + 1 - first) // 8)]
        rows = [
            (reading, *(f"{1e3 * values[k - first]:.1f}" for k in frames))
            for reading, values in found.items()
        ]
        head = ("mm from the default's surface in frame", *map(str, frames))
        tables.append(table(head, rows))
    return "\n\n".join(tables)


def kinect_frames(data):
    rows = {}
    for method, name in KINECT.items():
        found = _sft(data, "kinect_paper", method)
        if each := found["figures"].get("per_frame_mm") if found else None:
            rows[name] = each
    if not rows:
        return ""
    head = ("depth RMSE on the surface, mm, in frame", *next(iter(rows.values())))
    cells = lambda each: (f"{each[k]:.1f}" if k in each else "" for k in head[1:])
    return table(head, [(name, *cells(each)) for name, each in rows.items()])


def simulated(data):
    rows = []
    for sequence in SHEETS:
        found = [_sft(data, sequence, method) for method in ("adam", "gauss-newton")]
        if all(found):
            values = [(r["figures"]["e3d_proc"], r["figures"]["en_deg"]) for r in found]
            rows.append((sequence, *(f"{e:.4f} / {n:.1f}°" for e, n in values)))
    return table(("e3d, aligned / e_n", "paper's solver", "default"), rows) if rows else ""


def seconds(data):
    found = {m: _sft(data, "kinect_paper", m) for m in ("adam", "gauss-newton")}
    if not all(found.values()):
        return ""
    adam, ours = (found[m]["seconds_a_frame"] for m in ("adam", "gauss-newton"))
    return f"The paper's solver {adam:.0f} s a frame, the default {ours:.1f} s."


def stability(data):
    names, shown = ("change_rms_mm", "rmse_mm", "seconds"), []
    head = ("iterations", "from the surface at 300, mm", "error, mm", "processor's time, s")
    for scene in ("demo", "kinect_paper"):
        found = data[f"stability_{scene}"].get("counts", {})
        rows = [
            (count, *(f"{row[k]:.1f}" if k in row else "" for k in names))
            for count, row in found.items()
        ]
        if rows:
            picture = f"![Surfaces by iterations, {scene}](stability_{scene}.png)"
            shown += [table((f"{scene}: {head[0]}", *head[1:]), rows), picture]
    return "\n\n".join(shown)


def onefit_trainings(data):
    def asked(row):
        own = row["command"].removeprefix("python -m onefit.train").partition("-o ")[0].strip()
        return f"`{own}`" if own else ""

    found = data["onefit_paper"].get("trained", {})
    rows = [
        (name, asked(row), row["steps"], row["batch"], f"{row['minutes']:.0f}")
        for name, row in found.items()
    ]
    return table(("network", "asked for", "steps", "batch", "minutes"), rows) if rows else ""


def collisions(data):
    found, rows = data["onefit_paper"].get("collisions", {}), []
    for name in dict.fromkeys([*COLLISIONS, *found]):
        if name in COLLISIONS:
            rows.append((name, "paper", *(f"{v:.2f}" for v in COLLISIONS[name])))
        if name in found:
            own = [found[name]["trousers" if g == "pants" else g] for g in SIX]
            rows.append((name, "ours", *(f"{v:.2f}" for v in own)))
    return table(("ε_c %, trained on", "", *(GARMENTS[g] for g in SIX)), rows)


def jumpsuit(data):
    found = data["onefit_paper"].get("jumpsuit", {})
    rows = []
    for name in dict.fromkeys([*JUMPSUIT, *found]):
        paper = f"{JUMPSUIT[name]:.2f}" if name in JUMPSUIT else ""
        rows.append((name, paper, f"{found[name]:.2f}" if name in found else "not measured yet"))
    return table(("ε_c %", "paper", "ours"), rows)


def losses(data):
    ours = [data["onefit_paper"].get(name, {}) for name in ("losses", "losses_longer")]
    shown = lambda x: " / ".join(f"{v:.2f}" for v in x)
    rows = [
        (name, shown(LOSSES.get(name, ())))
        + tuple(
            shown(x[name][k] for k in ("edge", "area", "collision")) if name in x else "–"
            for x in ours
        )
        for name in dict.fromkeys([*LOSSES, *ours[0]])
    ]
    return table(("ε_e / ε_a / ε_c %", "paper", "ours, 720 steps", "2,880 steps"), rows)


def styles(data):
    found = data["onefit_paper"].get("styles", {})
    rows = [
        (name, *(f"{row[k]:.2f}" for k in ("edge", "area", "collision")))
        for name, row in found.items()
    ]
    return table(("tank top", "ε_e %", "ε_a %", "ε_c %"), rows) if rows else ""


def poses(data):
    found = data["onefit_paper"].get("poses", {})
    rows = [(name, f"{value:.2f}") for name, value in found.items()]
    shown = "\n\n![The four poses, side by side](paper_poses.jpg)"
    return table(("garment, motion", "ε_c %"), rows) + shown if rows else ""


def resolutions(data):
    found = data["onefit_paper"].get("resolutions", [])
    rows = [
        (r["vertices"], r["patches"], *(f"{r[k]:.2f}" for k in ("cut_seconds", "ms", "collision")))
        for r in found
    ]
    head = ("vertices", "patches", "cut, once [s]", "ms a frame", "ε_c %")
    return table(head, rows) if rows else ""


def speed(data):
    found = data["onefit_speed"].get("rows", [])
    if not found:
        return ""
    rows = [("paper, on a GPU", "", "0.48", "3 to 4")]
    for row in found:
        cells = (f"{row[k][1]:.2f}" for k in ("patches_alone", "network", "post"))
        rows.append((f"{row['vertices']} vertices", *cells))
    for part in data["gpu"].get("parts", []):
        if part["name"] == "drape":
            network = part["figures"]["the network alone [ms a frame]"]
            rows.append(("15807 vertices, on an NVIDIA H200", "", f"{network:.2f}", ""))
    head = ("ms a frame, least", "patches alone", "network alone", "post-processing")
    return table(head, rows)


def orders(data):
    found = data["polyfit_accuracy"].get("orders", {})
    if not found:
        return ""
    kinds = list(next(iter(found.values())))
    head = ("order", *(f"{kind}, {frame}" for kind in kinds for frame in ("PCA", "STN")))
    rows = [
        (order, *(both(row[kind][frame]) for kind in kinds for frame in ("PCA", "STN")))
        for order, row in found.items()
    ]
    plot = "![Height and normals by the order of the jets](paper_orders.png)"
    return f"{table(head, rows)}\n\n{plot}"


def transformer(data):
    return _by_kind(
        data["polyfit_accuracy"].get("frames", {}),
        {"PCA": "0.0259 / 5.47°", "with the STN": "0.0201 / 5.27°"},
        "frame",
    )


def networks(data):
    return _by_kind(data["polyfit_accuracy"].get("networks", {}), BACKBONES, "network", ms=True)


def families(data):
    return _by_kind(data["polyfit_accuracy"].get("sources", {}), FAMILIES, "trained on")


def tuned(data):
    found = data["polyfit_accuracy"].get("sources", {})
    about = data["polyfit_accuracy"].get("trained", {}).get("tuned")
    names = "4 families", "4 families, fine-tuned on garment patches"
    if not about or not all(name in found for name in names):
        return ""
    before, after = (both(found[name]["folded"]) for name in names)
    return (
        f"Of the four families alone, then {about['steps']} steps with {about['patches']:,}"
        f" patches of six garments, {60 * about['minutes']:.0f} s: height / normals on folded"
        f" patches of other garments go from {before} to {after}."
    )


def _by_kind(found, paper, first, ms=False):
    """A row for each of ``found``: height / normals by the kind of patches, and the paper's."""
    if not found:
        return ""
    kinds = [kind for kind in next(iter(found.values())) if kind != "ms"]
    head = (first, *kinds, *(["ms a patch"] if ms else []), "paper, CLOTH3D")
    rows = [
        (
            name,
            *(both(row[kind]) for kind in kinds),
            *([f"{row['ms']:.3f}"] if ms else []),
            paper.get(name, ""),
        )
        for name, row in found.items()
    ]
    return table(head, rows)
