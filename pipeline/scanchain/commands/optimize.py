"""``scanchain optimize``: a pose graph from a file to its certified minimum, and the report on it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from scanchain.commands.options import PATH, OverrideCommand, check_output, key_option, overrides
from scanchain.errors import FREEDOM, InputError, counted, remedy_of
from scanchain.settings import Override, load_settings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from scanchain.config import GraphConfig
    from scanchain.graph.certificate import Certificate
    from scanchain.graph.edge_checks import FreePose
    from scanchain.graph.g2o import G2oFile, Indefinite
    from scanchain.graph.initialize import Initialization
    from scanchain.graph.optimization import GraphChange, Optimization

_INITIALIZATIONS = ("auto", "given", "odometry", "spanning-tree", "chordal")
_POOR_FIT = 10.0  # χ² per degree of freedom, above which no noise model that is a little off explains it
_HALF = 0.5  # robust weight below which an edge is contradicted by the rest, rejected or not


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--graph.key VALUE]...")
@click.argument("source", metavar="GRAPH.g2o", type=PATH)
@click.option(
    "--out", metavar="FILE", type=PATH, help="Write the optimized graph: .g2o, or TORO's .graph or .toro."
)
@key_option(
    "--optimizer",
    "graph.optimizer",
    metavar="NAME",
    help="levenberg-marquardt, gauss-newton, dogleg, newton or gradient-descent; short for --graph.optimizer.",
)
@click.option(
    "--initialize",
    type=click.Choice(_INITIALIZATIONS),
    default="auto",
    show_default=True,
    help="Initial guess; auto takes the file's, or the chordal one if that is poor.",
)
@key_option(
    "--robust",
    "graph.robust",
    metavar="KERNEL",
    help="Robust loss of edges that skip poses: truncated, geman-mcclure, tukey, cauchy, huber. [default: none]",
)
@click.option(
    "--indefinite",
    type=click.Choice(("project", "refuse")),
    default="project",
    show_default=True,
    help="Information matrices that are not positive semidefinite: project to the nearest that is, or refuse.",
)
@click.option(
    "--marginals",
    metavar="all|IDS",
    help="Write marginal covariances of these poses, in their own frames, to a .marginals.csv beside --out.",
)
@click.option("--png", metavar="FILE", type=PATH, help="Draw the graph before and after optimization.")
@click.option("--recording", metavar="FILE.rrd", type=PATH, help="Record the graph before and after optimization.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def optimize(
    ctx: click.Context,
    source: Path,
    out: Path | None,
    initialize: str,
    indefinite: str,
    marginals: str | None,
    png: Path | None,
    recording: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Optimize a pose graph and certify whether the minimum is global.

    GRAPH is a g2o file (SE2, SE3:QUAT, XY) or a TORO file. The certificate is a lower bound of χ² over all poses.
    Edges rejected by --robust count in no χ²: --out FILE.g2o holds the edges in force, with their robust weights
    in their information matrices, and FILE_rejected.g2o the rejected ones, if any. Poses that did not converge are
    written all the same, and the exit code is 1.

    \b
    Examples:
      scanchain optimize sphere2500.g2o --out optimized.g2o
      scanchain optimize sphere2500.g2o --png sphere.png --json
      scanchain optimize candidates.g2o --robust truncated --out robust.g2o --marginals all
      scanchain optimize manhattan.g2o --initialize spanning-tree --optimizer dogleg --graph.max_iterations 100
    """
    outputs = Outputs(out, marginals, png, recording)
    outputs.check(force)
    settings = overrides(ctx)
    config = _config(settings)
    is_robust = config.robust != "none" and any(setting.key == "graph.robust" for setting in settings)
    file = _read(source, cast("Indefinite", indefinite), is_robust)
    report = _solved(file, source.name, config, cast("Initialization", initialize))
    written = outputs.write(report)
    click.echo(report.json(written) if as_json else report.text(written))
    if not report.optimization.converged:
        ctx.exit(1)


@dataclass(frozen=True, slots=True)
class Outputs:
    """Files to write, and the poses whose covariances are requested."""

    graph: Path | None
    marginals: str | None
    picture: Path | None
    recording: Path | None

    @property
    def table(self) -> Path | None:
        """File of the covariances."""
        return self.graph.with_suffix(".marginals.csv") if self.graph and self.marginals else None

    @property
    def paths(self) -> list[Path]:
        """Every requested file."""
        return [path for path in (self.graph, self.table, self.picture, self.recording) if path is not None]

    @property
    def rejected(self) -> Path | None:
        """File of the rejected edges, written if there are any."""
        from scanchain.graph.g2o import rejected_path

        return rejected_path(self.graph) if self.graph else None

    def check(self, force: bool) -> None:
        """Refuse, before the work, files that could not be written after it."""
        if self.marginals is not None and self.graph is None:
            raise InputError("--marginals writes a table beside the graph; give --out FILE")
        from scanchain.graph.g2o import GRAPH_SUFFIXES

        endings = {self.graph: GRAPH_SUFFIXES, self.picture: (".png",), self.recording: (".rrd",)}
        for path in (*self.paths, *filter(None, [self.rejected])):
            check_output(path, force=force, endings=endings.get(path, ()))

    def write(self, report: GraphReport) -> list[Path]:
        """Write them all and return their paths."""
        from scanchain.graph.covariance import chosen_poses, write_covariances
        from scanchain.graph.g2o import write_g2o

        file = report.file
        chosen = chosen_poses(self.marginals, file.ids) if self.marginals is not None else file.ids[:0]
        written = self.paths
        if self.graph is not None and self.rejected is not None:
            with _written(self.graph):
                write_g2o(self.graph, file.graph, ids=file.ids, other_lines=file.other_lines, force=True)
            with _written(self.rejected):
                if file.graph.is_rejected.any():
                    write_g2o(self.rejected, file.graph, ids=file.ids, edges="rejected", force=True)
                    written.insert(1, self.rejected)
                else:  # of an earlier report, whose place --force gave away
                    self.rejected.unlink(missing_ok=True)
        if self.table is not None:
            with _written(self.table):
                write_covariances(self.table, file.ids[chosen], file.graph.covariances()[chosen])
        if self.picture is not None:
            from scanchain_viz.report.problems import draw_graph

            with _written(self.picture):
                draw_graph(report.change, self.picture)
        if self.recording is not None:
            from scanchain_viz.recording.results import record_graph

            with _written(self.recording):
                record_graph(report.change, self.recording)
        return written


@contextmanager
def _written(path: Path) -> Generator[None]:
    """Name the file that could not be written, and the remedy."""
    try:
        yield
    except OSError as error:
        if remedy_of(error):
            raise
        raise InputError(f"{path}: not writable ({error.strerror}); choose another place") from error


def _config(settings: Sequence[Override]) -> GraphConfig:
    """The graph's branch of the configuration; other keys are refused."""
    for setting in settings:
        if not setting.key.startswith("graph."):
            raise InputError(f"{setting.flag} has no meaning for optimize; its keys begin with --graph.")
    return load_settings(overrides=settings).config.graph


def _read(source: Path, indefinite: Indefinite, is_robust: bool) -> G2oFile:
    """The graph, with a warning where matrices were projected."""
    from scanchain.graph.g2o import read_g2o

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = read_g2o(source, loops="robust" if is_robust else "quadratic", indefinite=indefinite)
    if file.projection is not None:
        remedy = "fix the program that wrote them, or stop here with --indefinite refuse"
        click.echo(f"warning: {source}: {file.projection.text}; {remedy}", err=True)
    return file


def _solved(file: G2oFile, name: str, config: GraphConfig, initialize: Initialization) -> GraphReport:
    """Optimize and certify."""
    from scanchain.graph.optimization import GraphChange

    before = file.graph.state()
    done = file.graph.optimize(config, initialize=initialize)
    change = GraphChange(name, before, done.state)
    free, weak = file.graph.free_poses(), file.graph.weakly_joined()
    return GraphReport(file, change, done, free, weak, file.graph.certify())


@dataclass(frozen=True, slots=True)
class GraphReport:
    """Everything to print about an optimized graph."""

    file: G2oFile
    change: GraphChange
    optimization: Optimization
    free: tuple[FreePose, ...]
    weak: NDArray[np.int64]
    certificate: Certificate

    def text(self, written: list[Path]) -> str:
        """One line per fact."""
        from scanchain.graph.edge_checks import free_text, weak_text

        graph, done = self.file.graph, self.optimization
        guess = done.initialization
        if guess == "given":
            guess = "the file's poses" if self.file.has_guess else "odometry, as the file has no vertices"
        size = f"{graph.dimension}D, {counted(len(graph), 'pose')}, {counted(len(graph.edges), 'edge')}"
        lines = [
            *(f"warning        {warning}" for warning in self._warnings),
            f"graph          {self.change.name}: {size}",
            *(f"kept as is     {counted(count, 'line')} {tag}" for tag, count in self.file.other_tags),
        ]
        if projection := self.file.projection:
            lines.append(
                f"projected      {projection.edges:,} of {projection.of:,} indefinite information matrices"
            )
        ending = done.reason if done.converged else f"DID NOT CONVERGE: {done.reason}"
        lines += [
            f"initial guess  {guess}",
            f"chi2           {self._chi2}",
            f"iterations     {done.iterations:,} in {1e3 * done.time_s:.0f} ms; {ending}",
        ]
        held = ""
        if loops := int(graph.is_loop.sum()):
            held = ", with fixed robust weights"
            rest = "; they do not count" if done.rejected.any() else ""
            lines += [
                f"robust         on {counted(loops, 'loop edge')}; the other "
                f"{counted(len(graph.edges) - loops, 'edge')} (odometry, points) in full weight",
                f"rejected       {done.rejected.sum():,} of {loops:,} loop edges{rest}",
            ]
        if self.free:
            lines.append(f"free           {free_text(self.free)}")
        if len(self.weak):
            lines.append(f"weakly joined  {weak_text(self.weak)}")
        lines.append(f"certificate    {self.certificate.verdict}{held}; {1e3 * self.certificate.time_s:.0f} ms")
        return "\n".join([*lines, *(f"written        {path}" for path in written)])

    @property
    def _warnings(self) -> list[str]:
        """Warnings to read before the rest."""
        notes = [self.file.note] if self.file.note else []
        after, graph = self.change.after, self.file.graph
        notes += [f"odometry {line}; so are its edges in --out" for line in graph.corrections(self.file.ids)]
        ratio = after.chi2 / max(after.degrees_of_freedom, 1)
        if not graph.is_loop.any() and after.degrees_of_freedom and ratio > _POOR_FIT:
            notes.append(
                f"chi2 is {ratio:.3g} per degree of freedom, where 1 is expected: some edges are wrong, or the "
                "information matrices are too large; --robust truncated finds wrong loop edges"
            )
        weight = graph.weight[graph.is_loop]
        downweighted = int((weight < _HALF).sum())
        if 2 * downweighted <= len(weight):
            return notes
        return [
            *notes,
            f"{downweighted:,} of {len(weight):,} loop edges are rejected or have a weight below ½: if they are "
            "right, all below is wrong; the certificate covers the edges in force, not their selection",
        ]

    @property
    def _chi2(self) -> str:
        """χ² of the edges in force before and after, with the degrees of freedom."""
        from scanchain.graph.optimization import fit, has_loops

        before, after = self.change.before, self.change.after
        first = f"{before.chi2:.6g} before, over {counted(before.degrees_of_freedom, *FREEDOM)}"
        second = f"{after.chi2:.8g} after, over {counted(after.degrees_of_freedom, *FREEDOM)}"
        if has_loops(after):
            return f"{first}; {second}"
        return f"{first}; after, {fit(after)}" if has_loops(before) else fit(after)

    def json(self, written: list[Path]) -> str:
        """The same, and every rejected edge, by vertex ids."""
        graph, done = self.file.graph, self.optimization
        tree = {
            "warnings": self._warnings,
            "graph": self.change.name,
            "dimension": graph.dimension,
            "poses": len(graph),
            "edges": len(graph.edges),
            "robust_edges": int(graph.is_loop.sum()),
            "rejected": self.file.ids[done.state.edges[done.rejected]].tolist(),
            "projected": None if self.file.projection is None else asdict(self.file.projection),
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
            "free": [asdict(pose) for pose in self.free],
            "weakly_joined": self.weak.tolist(),
            "certificate": asdict(self.certificate) | {"relative_gap": self.certificate.relative_gap},
            "written": [str(path) for path in written],
        }
        return json.dumps(tree, indent=2)
