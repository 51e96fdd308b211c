"""The picture of docs/architecture.md, drawn from the imports and from the contract of layers in pyproject.toml.

python -m tests.docs.architecture
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import grimp
import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from tests.support.scenes import ROOT

FILE = ROOT / "docs" / "pictures" / "architecture.svg"
WIDTH, HEIGHT = 11.0, 8.0  # inches
FOUNDATION = "range_noise"  # from its row on, whatever imports it is not drawn
ACROSS = 9  # largest number of boxes of the foundation next to each other
BOX_HEIGHT = 0.52  # of the distance between two layers


def layers() -> list[list[str]]:
    """The contract: rows of packages and modules, from the top; each imports from the rows below it only."""
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    contract = next(each for each in tools["importlinter"]["contracts"] if each["type"] == "layers")
    return [[name.strip() for name in row.split("|")] for row in contract["layers"]]


def imports() -> set[tuple[str, str]]:
    """Pairs (importer, imported) of packages and modules of the rows, without those that follow from others."""
    names = [name for row in layers() for name in row]
    sys.path.insert(0, str(ROOT / "pipeline"))
    graph = grimp.build_graph("scanchain", cache_dir=None)
    direct = {name: set[str]() for name in names}
    for module in graph.modules:
        importer = [*module.split("."), ""][1]
        for other in graph.find_modules_directly_imported_by(module) if importer in direct else ():
            imported = [*other.split("."), ""][1]
            if imported in direct and imported != importer:
                direct[importer].add(imported)
    reached: dict[str, set[str]] = {}
    for name in reversed(names):  # from the bottom: what is imported is known already
        reached[name] = direct[name].union(*(reached[each] for each in direct[name]))
    return {
        (name, other)
        for name in names
        for other in direct[name]
        if not any(other in reached[each] for each in direct[name] - {other})
    }


def draw() -> Figure:
    """Rows of boxes, one for each package or module, and lines to what each imports directly only."""
    whole = layers()
    cut = next(y for y, row in enumerate(whole) if FOUNDATION in row)
    base = [name for row in whole[cut:] for name in row]
    rows = whole[:cut] + [base[k : k + ACROSS] for k in range(0, len(base), ACROSS)]
    figure = Figure((WIDTH, HEIGHT))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    at: dict[str, tuple[float, float]] = {}
    for y, row in enumerate(rows):
        shift = 0.07 * (-1) ** y if len(row) == 1 else 0.0  # so that lines past a single box stay visible
        for k, name in enumerate(row):
            at[name] = (k + 0.5) / len(row) + shift, float(y)
    axes.axhspan(cut - 0.5, len(rows) - 0.5, color="#f3f3f0", zorder=0)
    for importer, imported in imports():
        if imported in base:
            continue
        (x0, y0), (x1, y1) = at[importer], at[imported]
        axes.plot([x0, x1], [y0 + BOX_HEIGHT / 2, y1 - BOX_HEIGHT / 2], color="#8899aa", linewidth=0.7, zorder=1)
    for name, (x, y) in at.items():
        color = "#e3edf7" if (ROOT / "pipeline" / "scanchain" / name).is_dir() else "white"
        box = {"boxstyle": "round,pad=0.35", "facecolor": color, "edgecolor": "#41608a"}
        axes.text(x, y, name, ha="center", va="center", fontsize=10.0, bbox=box, zorder=2)
    return figure


def main(path: Path = FILE) -> None:
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "scanchain"}):
        FigureCanvasSVG(draw()).print_svg(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
