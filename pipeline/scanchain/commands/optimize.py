"""``scanchain optimize``: a pose graph from a file to its certified minimum, and the report on it."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.data import DOWNWEIGHTED
from scanchain.errors import FREEDOM, InputError, counted, folded
from scanchain.files import json_text
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from scanchain.graph.certificate import Certificate
    from scanchain.graph.edge_noise import Noise
    from scanchain.graph.g2o import G2oFile, Indefinite
    from scanchain.graph.initialize import Initialization
    from scanchain.graph.optimization import GraphChange, Optimization

_INITIALIZATIONS = ("auto", "given", "odometry", "spanning-tree", "chordal")


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--graph.key VALUE]...")
@click.argument("source", metavar="GRAPH.g2o", type=PATH)
@click.option(
    "--out", metavar="FILE", type=PATH, help="Write the optimized graph: .g2o, or TORO's .graph or .toro."
)
@options.key(
    "--optimizer",
    "graph.optimizer",
    metavar="NAME",
    help="levenberg-marquardt, gauss-newton or gradient-descent; short for --graph.optimizer.",
)
@click.option(
    "--initialize",
    type=click.Choice(_INITIALIZATIONS),
    default="auto",
    help="Initial guess; auto takes the file's, or the chordal one if that is poor.",
)
@options.key(
    "--robust",
    "graph.robust",
    metavar="KERNEL",
    help="Robust loss of edges that skip poses: truncated, geman-mcclure, tukey, cauchy, huber. [default: none]",
)
@click.option(
    "--indefinite",
    type=click.Choice(("project", "refuse")),
    default="project",
    help="Information matrices that are not positive semidefinite: project to the nearest that is, or refuse.",
)
@click.option(
    "--noise",
    type=click.Choice(("auto", "information", "covariance", "square-root")),
    default="auto",
    help="What the matrices in the lines are; auto is information, and covariance where GTSAM has that.",
)
@click.option(
    "--marginals",
    metavar="all|IDS",
    help="Write marginal covariances of these poses, in their own frames, to a .marginals.csv next to --out.",
)
@click.option("--png", metavar="FILE", type=PATH, help="Draw the graph before and after optimization.")
@click.option("--recording", metavar="FILE.rrd", type=PATH, help="Record the graph before and after optimization.")
@options.force("files that exist")
@options.as_json
def optimize(
    source: Path,
    out: Path | None,
    initialize: str,
    indefinite: str,
    noise: str,
    marginals: str | None,
    png: Path | None,
    recording: Path | None,
    force: bool,
    as_json: bool,
    overrides: tuple[Override, ...],
) -> int:
    """Optimize a pose graph and certify whether the minimum is global.

    GRAPH is a g2o file (SE2, SE3:QUAT, XY), a TORO file, or a text file of GTSAM or iSAM. The certificate is a
    lower bound of χ² over all poses. Edges rejected by --robust count in no χ²: --out FILE.g2o holds the edges in
    force, with their robust weights in their information matrices, and FILE_rejected.g2o the rejected ones, if
    any. Poses that did not converge are written all the same, and the exit code is 1.

    \b
    Examples:
      scanchain optimize sphere2500.g2o --out optimized.g2o
      scanchain optimize sphere2500.g2o --png sphere.png --json
      scanchain optimize candidates.g2o --robust truncated --out robust.g2o --marginals all
      scanchain optimize manhattan.g2o --initialize spanning-tree --optimizer gauss-newton
    """
    from scanchain.graph.covariance import chosen_poses
    from scanchain.graph.g2o import GRAPH_SUFFIXES, rejected_path
    from scanchain.graph.optimization import GraphChange

    if marginals is not None and out is None:
        raise InputError("--marginals writes a table next to the graph; give --out FILE")
    rejected = rejected_path(out) if out else None
    table = out.with_suffix(".marginals.csv") if out and marginals else None
    endings = {out: GRAPH_SUFFIXES, rejected: (), table: (), png: (".png",), recording: (".rrd",)}
    for path, allowed in endings.items():
        if path is not None:
            options.check_output(path, force=force, endings=allowed)
    for override in overrides:
        if not override.key.startswith("graph."):
            raise InputError(f"{override.flag} has no meaning for optimize; its keys begin with --graph.")
    config = load_settings(overrides=overrides).config.graph
    is_robust = config.robust != "none" and any(override.key == "graph.robust" for override in overrides)
    file = _read(source, cast("Indefinite", indefinite), cast("Noise", noise), is_robust)
    graph, ids, before = file.graph, file.ids, file.graph.state()
    chosen = None if marginals is None else chosen_poses(marginals, ids)
    done, certificate = graph.optimize_globally(config, initialize=cast("Initialization", initialize))
    change = GraphChange(source.name, before, done.state)
    report = _Report(file, change, done, graph.free_poses(), graph.weakly_joined(), certificate)
    written = _write(file, change, chosen, out, png, recording)
    lines = [*report.lines(), *(("written", path) for path in written)]
    text = "\n".join(f"{name:<15}{fact}" for name, fact in lines)
    click.echo(json_text(report.tree() | {"written": written}) if as_json else folded(text))
    return int(not done.converged)


def _write(
    file: G2oFile,
    change: GraphChange,
    chosen: NDArray[np.int64] | None,
    out: Path | None,
    png: Path | None,
    recording: Path | None,
) -> list[str]:
    """Paths of the requested files, written here, with the marginal covariances of the chosen poses (M,)."""
    from scanchain.graph.covariance import write_covariances
    from scanchain.graph.g2o import rejected_path, write_g2o

    graph, ids = file.graph, file.ids
    written: list[Path] = []
    if out is not None:
        write_g2o(out, graph, ids=ids, other_lines=file.other_lines, force=True)
        written.append(out)
        rejected = rejected_path(out)
        if graph.is_rejected.any():
            write_g2o(rejected, graph, ids=ids, edges="rejected", force=True)
            written.append(rejected)
        else:
            rejected.unlink(missing_ok=True)  # of an earlier call; --force allows replacing it
        if chosen is not None:
            table = out.with_suffix(".marginals.csv")
            write_covariances(table, ids[chosen], graph.covariances()[chosen])
            written.append(table)
    if png is not None:
        from scanchain_viz.report.problems import draw_graph

        draw_graph(change, png)
        written.append(png)
    if recording is not None:
        from scanchain_viz.recording.results import record_graph

        record_graph(change, recording)
        written.append(recording)
    return [str(path) for path in written]


def _read(source: Path, indefinite: Indefinite, noise: Noise, is_robust: bool) -> G2oFile:
    """The graph in the file; warns on stderr if information matrices were projected."""
    from scanchain.graph.g2o import read_g2o

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loops = "robust" if is_robust else "quadratic"
        file = read_g2o(source, loops=loops, indefinite=indefinite, noise=noise)
    if file.projection is not None:
        remedy = "fix the program that wrote them, or stop here with --indefinite refuse"
        click.echo(f"warning: {source}: {file.projection.text}; {remedy}", err=True)
    return file


@dataclass(frozen=True, slots=True)
class _Report:
    """Everything to print about an optimized graph."""

    file: G2oFile
    change: GraphChange
    optimization: Optimization
    free: NDArray[np.int64]
    weak: NDArray[np.int64]
    certificate: Certificate

    def lines(self) -> list[tuple[str, str]]:
        """Lines of the report, as pairs of name and text."""
        from scanchain.graph.edge_checks import free_text, weak_text

        file, graph, done = self.file, self.file.graph, self.optimization
        guess = done.initialization
        if guess == "relaxation":
            guess = "the minimum of the semidefinite relaxation, lower than from the first guess"
        if guess == "given":
            guess = "the file's poses" if file.has_guess else "odometry, as the file has no vertices"
        size = f"{graph.dimension}D, {counted(len(graph), 'pose')}, {counted(len(graph.edges), 'edge')}"
        lines = [("warning", warning) for warning in self.warnings]
        lines.append(("graph", f"{self.change.name}: {size}"))
        lines += [("kept as is", f"{counted(count, 'line')} {tag}") for tag, count in file.other_tags]
        if (projected := file.projection) is not None:
            of_all = f"{projected.edges:,} of {projected.of:,}"
            lines.append(("projected", f"{of_all} indefinite information matrices"))
        ending = done.reason if done.converged else f"DID NOT CONVERGE: {done.reason}"
        lines += [
            ("initial guess", guess),
            ("chi2", self._chi2),
            ("iterations", f"{done.iterations:,} in {1e3 * done.time_s:.0f} ms; {ending}"),
        ]
        loops, certified = int(graph.is_loop.sum()), self.certificate.verdict
        if loops:
            certified += ", with fixed robust weights"
            others = f"{counted(len(graph.edges) - loops, 'edge')} (odometry, points, priors)"
            lines.append(("robust", f"on {counted(loops, 'loop edge')}; the other {others} in full weight"))
            rest = "; they do not count" if done.rejected.any() else ""
            lines.append(("rejected", f"{done.rejected.sum():,} of {loops:,} loop edges{rest}"))
        if len(self.free):
            lines.append(("free", free_text(self.free)))
        if len(self.weak):
            lines.append(("weakly joined", weak_text(self.weak)))
        return [*lines, ("certificate", f"{certified}; {1e3 * self.certificate.time_s:.0f} ms")]

    @property
    def warnings(self) -> list[str]:
        """Warnings to read before the rest."""
        after, graph = self.change.after, self.file.graph
        notes = list[str]()
        if graph.left_out:
            notes.append(
                f"{graph.left_out} not understood: in neither chi2 nor certificate nor covariances; kept in --out"
            )
        notes += [f"odometry {line}; so are its edges in --out" for line in graph.corrections(self.file.ids)]
        ratio = after.chi2 / max(after.degrees_of_freedom, 1)
        # a slightly wrong noise model is no explanation
        if not graph.is_loop.any() and after.degrees_of_freedom and ratio > 10.0:
            notes.append(
                f"chi2 is {ratio:.3g} per degree of freedom, where 1 is expected: some edges are wrong, or the "
                "information matrices are too large; --robust truncated finds wrong loop edges"
            )
        weight = graph.weight[graph.is_loop]
        downweighted = int((weight < DOWNWEIGHTED).sum())
        if 2 * downweighted > len(weight):
            notes.append(
                f"{downweighted:,} of {len(weight):,} loop edges are rejected or have a weight below ½: if they "
                "are right, all below is wrong; the certificate covers the edges in force, not their selection"
            )
        return [*notes, *self.file.notes]

    @property
    def _chi2(self) -> str:
        """χ² of the edges in force before and after, with the degrees of freedom."""
        from scanchain.graph.optimization import fit, has_loops

        before, after = self.change.before, self.change.after
        of_before, of_after = (each.degrees_of_freedom for each in (before, after))
        if has_loops(after):
            both = f"{of_before:,} and " if of_before != of_after else ""
            freedom = f"{both}{counted(of_after, *FREEDOM)}"
            return f"{before.chi2:.6g} before, {after.chi2:.8g} after, over {freedom}"
        first = f"{before.chi2:.6g} before, over {counted(of_before, *FREEDOM)}"
        return f"{first}; after, {fit(after)}" if has_loops(before) else fit(after)

    def tree(self) -> dict[str, object]:
        """The report for JSON, with the vertex ids of every rejected edge."""
        graph, done = self.file.graph, self.optimization
        return {
            "warnings": self.warnings,
            "graph": self.change.name,
            "dimension": graph.dimension,
            "poses": len(graph),
            "edges": len(graph.edges),
            "robust_edges": int(graph.is_loop.sum()),
            "rejected": self.file.ids[done.state.edges[done.rejected]].tolist(),
            "projected": self.file.projection,
            "kept_lines": dict(self.file.other_tags),
            "chi2_before": done.chi2_before,
            "chi2_after": done.chi2_after,
            "degrees_of_freedom_before": self.change.before.degrees_of_freedom,
            "degrees_of_freedom": done.state.degrees_of_freedom,
            "cost_after": done.cost_after,
            "iterations": done.iterations,
            "converged": done.converged,
            "reason": done.reason,
            "initialization": done.initialization,
            "time_s": done.time_s,
            "free": self.free.tolist(),
            "weakly_joined": self.weak.tolist(),
            "certificate": asdict(replace(self.certificate, relaxed=None))
            | {"relative_gap": self.certificate.relative_gap, "lower_bound": self.certificate.lower_bound},
        }
