"""``scanchain optimize``: a pose graph from a file to its certified minimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from pipeline.commands.graph_answer import Answer
from pipeline.commands.outputs import check_output
from pipeline.commands.override_command import OverrideCommand, alias, overrides
from pipeline.errors import InputError
from pipeline.settings import Override, load_settings

if TYPE_CHECKING:
    from pipeline.config import GraphConfig
    from pipeline.graph.initialise import Initialisation
    from pipeline.runs.recorder import Viewing

_PATH = click.Path(path_type=Path)
_WAYS = ("auto", "given", "odometry", "spanning-tree", "chordal")


@click.command(cls=OverrideCommand, options_metavar="[OPTIONS] [--graph.key VALUE]...")
@click.argument("source", metavar="GRAPH.g2o", type=_PATH)
@click.option("--out", metavar="FILE", type=_PATH, help="Write the optimised graph: .g2o, or TORO's .graph.")
@click.option("--optimiser", metavar="NAME", help="Short for --graph.optimiser.")
@click.option(
    "--initialise",
    type=click.Choice(_WAYS),
    default="auto",
    show_default=True,
    help="First guess; auto takes the file's, or the chordal one where that is poor.",
)
@click.option(
    "--robust",
    metavar="KERNEL",
    help="Suspect edges that skip poses: truncated, geman-mcclure, tukey, cauchy, huber. [default: trust all]",
)
@click.option(
    "--marginals",
    metavar="all|IDS",
    help="Covariances of these poses, in their own frames, to a .marginals.csv beside --out.",
)
@click.option("--png", metavar="FILE", type=_PATH, help="Draw the graph before and after to a picture.")
@click.option("--recording", metavar="FILE.rrd", type=_PATH, help="Record the graph before and after for rerun.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@click.pass_context
def optimize(
    ctx: click.Context,
    source: Path,
    out: Path | None,
    initialise: str,
    marginals: str | None,
    png: Path | None,
    recording: Path | None,
    force: bool,
    as_json: bool,
    **shortcuts: str | None,
) -> None:
    """Optimise a pose graph and say whether the minimum is the global one.

    GRAPH is a g2o file (SE2, SE3:QUAT, XY) or a TORO one. The certificate bounds the χ² of any other poses from
    below; edges that --robust rejected do not count in it.

    \b
    Examples:
      scanchain optimize sphere2500.g2o --out optimised.g2o
      scanchain optimize sphere2500.g2o --png sphere.png --json
      scanchain optimize run/graph.g2o --robust truncated --out run/robust.g2o --marginals all
      scanchain optimize manhattan.g2o --initialise spanning-tree --optimiser dogleg --graph.max_iterations 100
    """
    outputs = Outputs(out, marginals, png, recording)
    outputs.check(force)
    settings = overrides(ctx, _aliases(shortcuts))
    config = _config(settings)
    is_suspicious = config.robust != "none" and any(setting.key == "graph.robust" for setting in settings)
    answer = _solved(source, config, cast("Initialisation", initialise), is_suspicious)
    outputs.write(answer, ctx.obj)
    click.echo(answer.json(outputs.paths) if as_json else answer.text(outputs.paths))


@dataclass(frozen=True, slots=True)
class Outputs:
    """The files to write, and the poses whose covariances are wanted."""

    graph: Path | None
    marginals: str | None
    picture: Path | None
    recording: Path | None

    @property
    def table(self) -> Path | None:
        """Where the covariances go."""
        return self.graph.with_suffix(".marginals.csv") if self.graph and self.marginals else None

    @property
    def paths(self) -> list[Path]:
        """Every file that is wanted."""
        return [path for path in (self.graph, self.table, self.picture, self.recording) if path is not None]

    def check(self, force: bool) -> None:
        """Refuse before the work what could not be written after it."""
        if self.marginals is not None and self.graph is None:
            raise InputError("--marginals writes a table beside the graph; give --out FILE")
        endings = {self.picture: ".png", self.recording: ".rrd"}
        for path in self.paths:
            check_output(path, force=force, ending=endings.get(path, ""))

    def write(self, answer: Answer, viewing: Viewing) -> None:
        """Write them all."""
        from pipeline.graph.covariance_table import chosen_poses, write_covariances
        from pipeline.graph.g2o_write import write_graph

        file = answer.file
        chosen = chosen_poses(self.marginals, file.ids) if self.marginals is not None else file.ids[:0]
        if self.graph is not None:
            write_graph(self.graph, file.graph, ids=file.ids, other_lines=file.other_lines)
        if self.table is not None:
            write_covariances(self.table, file.ids[chosen], file.graph.covariances()[chosen])
        if self.picture is not None:
            viewing.draw_graph(answer.change, self.picture)
        if self.recording is not None:
            viewing.record_graph(answer.change, self.recording)


def _aliases(options: dict[str, str | None]) -> list[Override]:
    """The keys that the short options stand for."""
    return [each for name, value in options.items() for each in alias(f"graph.{name}", value, f"--{name}")]


def _config(settings: Sequence[Override]) -> GraphConfig:
    """The graph's branch of the configuration; nothing else means anything here."""
    for setting in settings:
        if not setting.key.startswith("graph."):
            raise InputError(f"{setting.flag} has no meaning for optimize; its keys begin with --graph.")
    return load_settings(overrides=settings).config.graph


def _solved(source: Path, config: GraphConfig, initialise: Initialisation, is_suspicious: bool) -> Answer:
    """Read, optimise, certify."""
    from pipeline.graph.g2o import read_g2o
    from pipeline.graph.optimisation import GraphChange
    from pipeline.graph.soundness import check_connected

    file = read_g2o(source, loops="suspect" if is_suspicious else "trusted")
    check_connected(file.graph.edges, file.graph.fixed, file.ids)
    before = file.graph.state()
    done = file.graph.optimise(config, initialise=initialise)
    change = GraphChange(source.name, before, done.state, done.rejected)
    return Answer(file, change, done, file.graph.certify())
