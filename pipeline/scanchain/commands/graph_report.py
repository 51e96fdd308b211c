"""Report of ``scanchain optimize`` on a graph, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scanchain.errors import FREEDOM, counted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from scanchain.graph.certificate import Certificate
    from scanchain.graph.files.g2o import G2oFile
    from scanchain.graph.observability import FreePose
    from scanchain.graph.optimization import GraphChange, Optimization

_POOR_FIT = 10.0  # χ² per degree of freedom, above which no noise model that is a little off explains it
_HALF = 0.5  # robust weight below which an edge is contradicted by the rest, rejected or not


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
        graph, done = self.file.graph, self.optimization
        guess = done.initialization
        if guess == "given":
            guess = "the file's poses" if self.file.has_guess else "odometry, as the file has no vertices"
        size = f"{graph.dimension}D, {counted(len(graph), 'pose')}, {counted(len(graph.edges), 'edge')}"
        lines = [
            *(f"warning        {warning}" for warning in self._warnings),
            f"graph          {self.change.name}: {size}",
            *(f"kept as is     {counted(count, 'line')} {tag}" for tag, count in self.file.other_tags),
            *self._projected,
            f"initial guess  {guess}",
            f"chi2           {self._chi2}",
            f"iterations     {done.iterations:,} in {1e3 * done.time_s:.0f} ms; {self._ending}",
        ]
        if graph.is_loop.any():
            rest = "; they do not count" if done.rejected.any() else ""
            chain = len(graph.edges) - int(graph.is_loop.sum())
            lines.append(
                f"robust         on {counted(int(graph.is_loop.sum()), 'loop edge')}; "
                f"the other {counted(chain, 'edge')} (odometry, points) in full weight"
            )
            lines.append(f"rejected       {done.rejected.sum():,} of {graph.is_loop.sum():,} loop edges{rest}")
        lines += self._free
        held = ", with fixed robust weights" if graph.is_loop.any() else ""
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
    def _free(self) -> list[str]:
        from scanchain.graph.observability import free_text, weak_text

        lines = [f"free           {free_text(self.free)}"] if self.free else []
        return [*lines, f"weakly joined  {weak_text(self.weak)}"] if len(self.weak) else lines

    @property
    def _projected(self) -> list[str]:
        projection = self.file.projection
        if projection is None:
            return []
        return [f"projected      {projection.edges:,} of {projection.of:,} indefinite information matrices"]

    @property
    def _ending(self) -> str:
        """Reason why the iteration stopped."""
        done = self.optimization
        return done.reason if done.converged else f"DID NOT CONVERGE: {done.reason}"

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
