"""The pose graph: keyframe poses and the relative poses measured between them, grown one by one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanchain import checks, lie
from scanchain.clock import working_s
from scanchain.config import GraphConfig
from scanchain.data import REJECTED_WEIGHT, GraphState, Integers, Mask, Matrix, Pose, Vector
from scanchain.errors import InputError, counted
from scanchain.graph.certificate import Certificate, certify
from scanchain.graph.cholesky import SingularMatrixError
from scanchain.graph.covariance import difference_covariances, displacements, inverse_blocks, pose_errors
from scanchain.graph.edge_checks import (
    check_connected,
    check_edges,
    free_poses,
    free_text,
    own_equations,
    ranks,
    skip_poses,
    weakly_joined,
)
from scanchain.graph.explanation import Explainer
from scanchain.graph.factors import (
    FACTORS,
    LOOPS,
    ODOMETRY,
    ORIGIN,
    RELATIVE,
    WHOLE,
    Factor,
    kinds_of,
    of_residuals,
)  # fmt: skip
from scanchain.graph.initialize import Initialization
from scanchain.graph.odometry_errors import Explanation, InflatedSegment, corrected, odometry_of
from scanchain.graph.optimization import Optimization, Rejection, Since
from scanchain.graph.problem import GraphProblem
from scanchain.growing_array import GrowingArray

_LOWER = 1e-6  # share of the cost by which a minimum is lower than another one


class PoseGraph:
    """Poses T_world_lidar and between factors T_ij (frame j seen from frame i) with e = log(T_ij⁻¹ T_i⁻¹ T_j).

    Every covariance and information matrix, given or returned, is that of a right twist, T exp(ξ): in the pose's
    own frame, (translation, rotation). ``Match.information`` is one, so that an edge takes it unchanged.

    The gauge is fixed by keeping pose 0, or those given to ``fix``, constant; in a graph with unary factors, which
    refer to the origin of the world, by the origin.
    """

    def __init__(self, dimension: int, names: Integers | None = None, left_out: str = "") -> None:
        """Make an empty graph of SE(2) (dimension 2) or SE(3) (3) poses with these names in messages.

        left_out : constraints that the graph lacks, as text for the certificate
        """
        dimension = self.dimension = checks.dimension(dimension)
        self._names, self.left_out = names, left_out
        self.freedom = 3 if dimension == 2 else 6
        pose, k = (dimension + 1, dimension + 1), self.freedom
        self._poses, self._stamps_ns = GrowingArray(pose, np.float64), GrowingArray((), np.int64)
        self._edges, self._measurements = GrowingArray((2,), np.int64), GrowingArray(pose, np.float64)
        self._information, self._kind = GrowingArray((k, k), np.float64), GrowingArray((), np.int64)
        self._factors: list[Factor] = list(FACTORS)
        self._counts: set[tuple[int, int]] = set()  # of residuals, that factors of a kind have been seen to return
        self._weight, self._is_point = GrowingArray((), np.float64), GrowingArray((), np.bool_)
        self._rank = GrowingArray((), np.int64)
        self._of_edges = (
            self._edges, self._measurements, self._information, self._kind, self._rank, self._weight,
        )  # fmt: skip
        self._fixed: set[int] = set()
        self.since = Since(0, 0)
        self.work = 0.0  # multiplications that the factorizations of the last optimization took
        self._explanation = Explanation.none(k)
        self._problem: GraphProblem | None = None
        self._factor_is_now = False

    def __len__(self) -> int:
        return len(self._poses)

    def __repr__(self) -> str:
        loops = self.is_loop | (skip_poses(self.edges, self.is_point) & ~self.is_of_origin)
        edges = f"{counted(len(self.edges), 'edge')}, {loops.sum():,} of them loops"
        without = f"; without {self.left_out}" if self.left_out else ""
        return f"PoseGraph({counted(len(self), 'pose')} of SE({self.dimension}), {edges}{without})"

    @property
    def poses(self) -> Matrix:
        """T_world_lidar of every pose, (K, d+1, d+1)."""
        return self._poses.rows

    @property
    def names(self) -> Integers:
        """Name of every pose in messages, (K,); without names given, its index."""
        if self._names is None:
            return np.arange(len(self))
        more = len(self) - len(self._names)
        return np.append(self._names, self._names.max(initial=-1) + 1 + np.arange(more))[: len(self)]

    @property
    def stamps_ns(self) -> Integers:
        """Stamp of every pose, (K,)."""
        return self._stamps_ns.rows

    @property
    def edges(self) -> Integers:
        """Pose pairs (i, j), (E, 2), in the order they were added; i is ``ORIGIN``, −1, of factors of one pose."""
        return self._edges.rows

    @property
    def measurements(self) -> Matrix:
        """T_ij of every edge, (E, d+1, d+1), odometry corrected by ``drift``."""
        return self._applied(self._explanation)[0]

    @property
    def drift(self) -> Vector:
        """Odometry drift inferred from loop edges, (2,) or (4,): the share by which it is too short, missing turn.

        A pure number, and radians per meter about every axis; zero if loop edges show no drift.
        """
        return self._explanation.drift

    @property
    def inflated(self) -> tuple[InflatedSegment, ...]:
        """Slips and jumps: segments of odometry whose errors, by loop edges, exceed their covariance."""
        return self._explanation.inflated

    def corrections(self, names: Integers, noun: str = "poses") -> list[str]:
        """Drift, slips and jumps as text, one line each; ``names`` (K,) are the displayed numbers of the poses."""
        if not self.drift.any() and not self.inflated:
            return []
        odometry = odometry_of(self.edges, self.is_odometry)
        errors = self._prepared().errors(self._vertices)[odometry]
        arrays = self._measurements.rows[odometry], self._information.rows[odometry]
        return self._explanation.lines(names[self.edges[odometry]], noun, errors, *arrays)

    @property
    def information(self) -> Matrix:
        """Ω of every edge, (E, k, k), for odometry with inflated covariance in slips and jumps."""
        return self._applied(self._explanation)[1]

    def added_since(self, first: int) -> tuple[Matrix, Matrix]:
        """``measurements`` and ``information`` of this edge and all later ones, without all others if possible."""
        explanation, new = self._explanation, slice(first, None)
        before = int(self.is_odometry[:first].sum())
        if any(segment.edges.stop > before for segment in explanation.inflated):
            return self.measurements[new], self.information[new]
        drift = Explanation(explanation.drift)
        return drift.applied(
            self.edges[new], self._measurements.rows[new], self._information.rows[new], self.is_odometry[new]
        )

    @property
    def is_loop(self) -> Mask:
        """True for every loop edge, (E,)."""
        return (self._kind.rows[:, None] == LOOPS).any(axis=1)

    @property
    def is_odometry(self) -> Mask:
        """True for every edge of odometry, (E,)."""
        return self._kind.rows == ODOMETRY

    @property
    def is_of_origin(self) -> Mask:
        """True for every unary edge, which constrains one pose only, (E,)."""
        return self.edges[:, 0] == ORIGIN

    @property
    def is_custom(self) -> Mask:
        """True for every edge of a factor that is not of this package, (E,)."""
        return self._kind.rows >= len(FACTORS)

    @property
    def weight(self) -> Vector:
        """Weight of every edge after the last optimization, (E,); 1 before any."""
        return self._weight.rows

    @property
    def is_rejected(self) -> Mask:
        """True for every edge that the last optimization rejected, (E,)."""
        return self.weight < REJECTED_WEIGHT

    @property
    def is_point(self) -> Mask:
        """True for every pose that is a point, without a heading, (K,)."""
        return self._is_point.rows

    @property
    def fixed(self) -> Mask:
        """True for every fixed pose, (K,); without any by ``fix`` or information on a single pose, pose 0."""
        result = np.zeros(len(self), np.bool_)
        result[sorted(self._fixed) or slice(0, 0 if self._rank.rows[self.is_of_origin].any() else 1)] = True
        return result

    @property
    def held(self) -> list[int]:
        """Poses fixed by ``fix``, ascending."""
        return sorted(self._fixed)

    def add_pose(self, T_world: Pose, stamp_ns: int) -> int:
        """Index of the new pose, which is added with this initial guess."""
        return self._append(checks.pose(T_world, "T_world", self.dimension), stamp_ns, is_point=False)

    def add_point(self, position: Vector, stamp_ns: int) -> int:
        """Index of a new point of the plane (2,): it counts among the poses, with the identity as its rotation."""
        if self.dimension != 2:
            raise InputError("a point of the plane was added to a graph of SE(3) poses; make it PoseGraph(2)")
        x_m, y_m = checks.matrices(position, "position", (2,)).tolist()
        return self._append(lie.pose_2d(x_m, y_m, 0.0), stamp_ns, is_point=True)

    def add_edge(self, i: int, j: int, T_ij: Pose, information: Matrix, is_loop: bool = False) -> None:
        """Add a measurement of frame j in frame i.

        information (k, k) is the inverse covariance of e = log(T_ij⁻¹ T_i⁻¹ T_j), a right twist on T_ij, as
        ``Match.information`` is. Loops get the robust loss.
        """
        T_ij = checks.pose(T_ij, "T_ij", self.dimension)
        information = checks.matrices(information, "information", (self.freedom, self.freedom))
        is_loop = checks.truth(is_loop, "is_loop")
        pair = [checks.integer(each, name, "the index of a pose") for each, name in ((i, "i"), (j, "j"))]
        self._add_edges(np.array([pair], np.int64), T_ij[None], information[None], np.array([is_loop]))

    def add_factor(
        self, factor: Factor, j: int, information: ArrayLike, Z: Pose | None = None, i: int = ORIGIN
    ) -> None:
        """Add a measurement of pose j by a factor of ``scanchain.graph.factors`` or a custom one.

        information : (m, m) inverse covariance of its m residuals
        Z : (d+1, d+1) the measurement, if the factor needs one
        i : the pose from which it is measured; by default the origin of the world
        Raises InputError for an unknown pose, and for information that does not match the factor's residuals.
        """
        checks.instance(factor, Factor, "factor", "an instance of a subclass of scanchain.graph.factors.Factor")
        Z = lie.identity(self.dimension) if Z is None else checks.pose(Z, "Z", self.dimension)
        pair = [checks.integer(each, name, "the index of a pose") for each, name in ((i, "i"), (j, "j"))]
        whole = of_residuals(information, self.freedom, factor)
        edge = np.array([pair], np.int64), Z[None], whole[None]
        check_edges(*edge, len(self), with_origin=True)
        known = (
            kind
            for kind, each in enumerate(self._factors)
            if each is factor or (kind < len(FACTORS) and type(each) is type(factor))
        )
        kind, count = next(known, len(self._factors)), len(np.asarray(information))
        if kind >= len(FACTORS) or (kind, count) not in self._counts:
            T_i, T_j = self.poses[[i, j]]  # copies
            factor.check(T_j if i == ORIGIN else lie.between(T_i, T_j), Z, count)
            self._counts.add((kind, count))
        name = type(factor).__name__
        if i == ORIGIN and kind in RELATIVE:
            raise InputError(f"{name} is measured from another pose; give i, or take Prior or Position")
        if kind in WHOLE and self.is_point[[j if i == ORIGIN else i, j]].any():
            raise InputError(f"{name} measures a rotation, which points have not; take Position or Sighting")
        if kind == len(self._factors):
            self._factors.append(factor)
        self._extend(*edge, np.array([kind]))

    def add_edges(self, edges: Integers, measurements: Matrix, information: Matrix, is_loop: Mask) -> None:
        """Add many edges: (E, 2), (E, d+1, d+1), (E, k, k), (E,)."""
        edges = checks.indices(edges, "edges")
        measurements = checks.poses(measurements, "measurements", self.dimension)
        information = checks.matrices(information, "information", (len(edges), self.freedom, self.freedom))
        is_loop = checks.truths(is_loop, "is_loop", len(edges))
        if len(measurements) != len(edges):
            raise InputError(
                f"measurements has {counted(len(measurements), 'entry', 'entries')}; "
                f"wanted one for each of {counted(len(edges), 'edge')}"
            )
        self._add_edges(edges, measurements, information, is_loop)

    def _add_edges(self, edges: Integers, measurements: Matrix, information: Matrix, is_loop: Mask) -> None:
        check_edges(edges, measurements, information, len(self))
        self._extend(edges, measurements, information, kinds_of(edges, information, self.is_point, is_loop))

    def _extend(self, edges: Integers, measurements: Matrix, information: Matrix, kind: Integers) -> None:
        self._changed()
        rows = edges, measurements, information, kind, ranks(information), np.ones(len(edges))
        for column, new in zip(self._of_edges, rows, strict=True):
            column.extend(new)

    def remove_edges(self, is_removed: Mask) -> None:
        """Remove edges, but none of odometry; is_removed (E,) is True for each edge to remove."""
        self._changed()
        for column in self._of_edges:
            column.replace(column.rows[~is_removed])
        self.since = Since(0, 0)

    def predicted(self, T_ij: Pose) -> Pose:
        """An odometry motion corrected by ``drift``."""
        return corrected(T_ij, self._explanation.drift)

    def fix(self, index: int) -> None:
        """Fix this pose instead of pose 0."""
        index = self._checked_index(index, "index")
        self._changed()
        self._fixed.add(index)

    def move(self, first: int, T_new_old: Pose) -> None:
        """Move this pose and all later ones rigidly, as an initial guess."""
        poses = self.poses.copy()
        poses[first:] = checks.pose(T_new_old, "T_new_old", self.dimension) @ poses[first:]
        self._changed()
        self._poses.replace(poses)

    def remeasure(self, edge: int) -> None:
        """Replace the measurement of an edge by the relative pose of its ends at the current poses."""
        measurements, (T_i, T_j) = self._measurements.rows.copy(), self._vertices[self._joined[edge]]
        measurements[edge] = lie.between(T_i, T_j)
        self._changed()
        self._measurements.replace(measurements)

    def optimize(
        self, config: GraphConfig, *, initialize: Initialization = "auto", rejection: Rejection = "judge"
    ) -> Optimization:
        """Move the poses to the minimum of χ², starting from the chosen initialization.

        rejection : of loop edges under the truncated loss: "judge" classifies all of them again; "update" is
            cheap: it starts from the present verdicts and judges new edges against these
        """
        checks.instance(config, GraphConfig, "config", "load_settings(dimension).config.graph")
        checks.one_of(initialize, get_args(Initialization), "initialize")
        checks.one_of(rejection, get_args(Rejection), "rejection")
        begin = working_s()
        problem = self._prepared()
        chi2_before = self._in_force(problem.chi2(problem.errors(self._vertices)))
        arrays = self._measurements.rows, self._information.rows
        explainer = Explainer(self._problem_of, *arrays, config, jumps=False)
        since = self.since if rejection == "update" else None
        try:
            explained = explainer.solve(self._explanation, self._vertices, initialize, since)
        except SingularMatrixError as error:
            raise self._singular(error, self.fixed) from error
        self._problem, self._explanation, minimum = explained.problem, explained.explanation, explained.minimum
        self._poses.replace(minimum.estimate.poses[: len(self)])
        self._weight.replace(minimum.weights)
        self._factor_is_now = False
        edges = len(self.edges)
        self.since = Since(self.since.judged if rejection == "update" else edges, edges)
        self.work = explained.problem.cholesky.work * minimum.iterations
        return Optimization(
            state=self.state(),
            chi2_before=chi2_before,
            chi2_after=self._in_force(minimum.estimate.chi2),
            cost_after=minimum.estimate.cost,
            iterations=minimum.iterations,
            converged=minimum.converged,
            reason=minimum.reason,
            initialization=minimum.initialization,
            time_s=working_s() - begin,
        )

    def optimize_globally(
        self, config: GraphConfig, *, initialize: Initialization = "auto"
    ) -> tuple[Optimization, Certificate]:
        """Optimize and certify; while not certified, again from the minimum of the relaxation if that is lower."""
        done = self.optimize(config, initialize=initialize)
        while (certificate := self.certify()).relaxed is not None and not certificate.certified:
            other = self.copy()
            other._poses.replace(certificate.relaxed[: len(self)])
            again = other.optimize(config, initialize="given")
            if not again.cost_after < (1.0 - _LOWER) * done.cost_after:
                break
            self.adopt(other)
            spent_s, iterations = done.time_s + again.time_s, done.iterations + again.iterations
            done = replace(
                again, chi2_before=done.chi2_before, initialization="relaxation", iterations=iterations,
                time_s=spent_s,
            )  # fmt: skip
        return done, certificate

    def optimize_end(self, config: GraphConfig, first: int, rejection: Rejection) -> None:
        """Optimize this pose and all later ones, with all others fixed.

        rejection : as in ``optimize``; loop edges that are judged may also be explained by jumps of odometry there
        """
        chosen = np.flatnonzero((self.edges >= first).any(axis=1))
        edges, kind, is_odometry = self._joined[chosen], self._kind.rows[chosen], self.is_odometry[chosen]
        measured, information = (each[chosen - chosen[0]] for each in self.added_since(int(chosen[0])))
        fixed = self._of_vertices((np.arange(len(self)) < first) | self.fixed, of_origin=True)

        def problem_of(explanation: Explanation) -> GraphProblem:
            applied = explanation.applied(edges, measured, information, is_odometry)
            return GraphProblem(edges, *applied, fixed, self._is_point_vertex, kind, self._factors)

        explainer = Explainer(problem_of, measured, information, config, jumps=True)
        since = Since(0, 0) if rejection == "update" else None
        try:
            end = explainer.solve(Explanation.none(self.freedom), self._vertices, "given", since)
        except SingularMatrixError as error:
            raise self._singular(error, fixed) from error
        before = int(self.is_odometry.sum() - is_odometry.sum())
        self._explanation = self._explanation.with_later(end.explanation, before)
        weight = self.weight.copy()
        weight[chosen] = end.minimum.weights
        self._poses.replace(end.minimum.estimate.poses[: len(self)])
        self._weight.replace(weight)
        self._changed()

    def copy(self) -> PoseGraph:
        """An independent copy of the graph."""
        result = PoseGraph(self.dimension, self._names, self.left_out)
        for name, rows in vars(self).items():
            if isinstance(rows, GrowingArray):
                getattr(result, name).extend(rows.rows)
        result._fixed, result._explanation = set(self._fixed), self._explanation
        result._factors = list(self._factors)
        result.since, result.work = self.since, self.work
        return result

    def in_force(self, first: int, last: int) -> PoseGraph:
        """A graph of the poses ``first`` to ``last`` − 1 and the edges in force between them, none robust."""
        graph = PoseGraph(self.dimension)
        for T, stamp_ns in zip(self.poses[first:last], self.stamps_ns[first:last].tolist(), strict=True):
            graph.add_pose(T, stamp_ns)
        kept = ~self.is_rejected & ((self.edges >= first) & (self.edges < last)).all(axis=1)
        edges = self.edges[kept] - first, self.measurements[kept], self.information[kept]
        graph.add_edges(*edges, np.zeros(int(kept.sum()), np.bool_))
        return graph

    def with_information(self, information: Matrix) -> PoseGraph:
        """A copy with these information matrices (E, k, k) and the corrected measurements of this graph."""
        result = self.copy()
        result._measurements.replace(self.measurements)
        result._information.replace(information)
        result._explanation = Explanation.none(self.freedom)
        return result

    def adopt(self, optimized: PoseGraph) -> None:
        """Adopt the result of optimizing a ``copy``; poses added since move with the last one before them."""
        count, edges = len(optimized), len(optimized.edges)
        T_new_old = optimized.poses[-1] @ lie.inverse(self.poses[count - 1])
        self._poses.replace(np.concatenate([optimized.poses, T_new_old @ self.poses[count:]]))
        self._weight.replace(np.concatenate([optimized.weight, self.weight[edges:]]))
        self._explanation = optimized._explanation
        self.since, self.work = optimized.since, optimized.work
        self._changed()

    def certify(self) -> Certificate:
        """Certificate of the global minimum of χ², with the edge weights of the last optimization."""
        graph = self._prepared(), self._vertices, self._weight_in_force
        return replace(certify(*graph, self._undetermined()), left_out=self.left_out)

    def free_poses(self) -> Integers:
        """Names of the poses that the edges in force leave free in some direction, at the current poses."""
        self._factor_is_now = False
        return free_poses(self._prepared(), self._vertices, self._weight_in_force, self._rank.rows, self.names)

    def weakly_joined(self) -> Integers:
        """Names of the poses joined to a fixed one only by edges in force with almost no information."""
        kept = ~self.is_rejected
        information = self.weight[kept, None, None] * self.information[kept]
        return self.names[weakly_joined(self._joined[kept], information, self._fixed_vertices)]

    def state(self) -> GraphState:
        """The graph as it is, for files and recordings; odometry edges first."""
        order, problem = np.argsort(self.is_loop, kind="stable"), self._prepared()
        chi2 = problem.chi2(problem.errors(self._vertices))
        return GraphState(
            poses=self.poses.copy(),
            stamps_ns=self.stamps_ns.copy(),
            edges=self.edges[order],
            is_loop=self.is_loop[order],
            weight=self.weight[order],
            chi2=self._in_force(chi2),
            edge_chi2=chi2[order],
            degrees_of_freedom=max(int(self._rank.rows[~self.is_rejected].sum()) - problem.pattern.scalars, 0),
        )

    def relative_covariance(self, i: int, j: int) -> Matrix:
        """Covariance (k, k) of T_ij = T_i⁻¹ T_j, a right twist on it as in ``add_edge``, at the current poses.

        In terms of left twists it is Ad(T_j⁻¹) Cov(ξ_j − ξ_i) Ad(T_j⁻¹)ᵀ. The factor of H is retained until the
        graph changes, so that each further pair costs k solves.
        """
        i, j = (self._checked_index(each, name) for each, name in ((i, "i"), (j, "j")))
        adjoint = lie.adjoint(lie.inverse(self.poses[j]))
        return adjoint @ difference_covariances(self._factored(), np.array([[i, j]]))[0, 0] @ adjoint.T

    def covariances(self) -> Matrix:
        """Covariance (K, k, k) of every pose's right twist, T exp(ξ), by the edges in force, at the current poses.

        By the selected inverse of H over such twists; zero for fixed poses, 2 × 2 for points: m², m rad, rad².
        Raises InputError where the edges leave poses free, or nearly free.
        """
        problem, undetermined = self._prepared(), self._undetermined()
        if undetermined:
            raise _refused(undetermined)
        self._factor_is_now = False
        try:
            information = self._weight_in_force[:, None, None] * self.information
            problem.cholesky.factorize(own_equations(problem, self._vertices, information))
        except SingularMatrixError as error:
            raise self._singular(error, self.fixed) from error
        result = np.zeros((len(self), self.freedom, self.freedom))
        result[problem.free] = inverse_blocks(problem)[: len(problem.free)]
        return result

    def pose_errors(self, count: int, seed: int = 0) -> Matrix:
        """Errors (count, K, k) of all poses, sampled from their joint distribution by the edges in force.

        They are of position and orientation, along the world's axes. Raises InputError where the edges leave poses
        free.
        """
        count = checks.integer(count, "count", "a number of samples, 1 or more", least=1)
        return pose_errors(self._factored(), self._vertices, count, seed)[:, : len(self)]

    def displacements(self, changes: Matrix) -> Matrix:
        """First-order changes (G, K, k) of all poses when the measured motions T_ij become T_ij exp(change).

        changes : (G, E, k) twists. The result is in position and orientation, along the world's axes. Raises
        InputError where the edges leave poses free.
        """
        return displacements(self._factored(), self._vertices, self.weight, changes)[:, : len(self)]

    def _append(self, T_world: Pose, stamp_ns: int, *, is_point: bool) -> int:
        stamp_ns = checks.integer(stamp_ns, "stamp_ns", "nanoseconds as int; of seconds int(1e9 * stamp_s)")
        self._changed()
        self._stamps_ns.append(stamp_ns)
        self._is_point.append(is_point)
        return self._poses.append(T_world)

    def _checked_index(self, index: int, name: str) -> int:
        index = checks.integer(index, name, "the index of a pose")
        if not 0 <= index < len(self):
            raise InputError(
                f"{name} is {index}, and the graph has {counted(len(self), 'pose')}; add the pose first"
            )
        return index

    def _factored(self) -> GraphProblem:
        """The problem, with the factor of the undamped H in its solver."""
        problem = self._prepared()
        if not self._factor_is_now:
            equations = problem.linearize(self._vertices, problem.errors(self._vertices), self.weight)
            try:
                problem.cholesky.factorize(equations.values)
            except SingularMatrixError as error:
                raise self._singular(error, self.fixed) from error
            self._factor_is_now = True
        return problem

    def _prepared(self) -> GraphProblem:
        """The least-squares problem; rebuilt after the graph has grown."""
        if self._problem is None:
            check_connected(self._joined[self._rank.rows > 0], self._fixed_vertices, self.names)
            self._problem = self._problem_of(self._explanation)
        return self._problem

    def _problem_of(self, explanation: Explanation) -> GraphProblem:
        """The problem under an explanation; the existing one if it has this explanation."""
        if self._problem is not None and explanation is self._explanation:
            return self._problem
        applied, kind = self._applied(explanation), self._kind.rows
        return GraphProblem(
            self._joined, *applied, self._fixed_vertices, self._is_point_vertex, kind, self._factors
        )

    def _applied(self, explanation: Explanation) -> tuple[Matrix, Matrix]:
        """Measurements and information of all edges under an explanation."""
        return explanation.applied(self.edges, self._measurements.rows, self._information.rows, self.is_odometry)

    def _undetermined(self) -> str:
        """Free poses, which preclude covariances and certificates, as text; empty without any."""
        free = self.free_poses()
        return free_text(free) if len(free) else ""

    def _singular(self, error: SingularMatrixError, fixed: Mask) -> InputError:
        """The error for poses that their edges leave free, or nearly free."""
        variable = np.flatnonzero(~fixed)[[error.variable]]
        return _refused(self._undetermined() or free_text(self.names[variable]))

    @property
    def _has_origin(self) -> bool:
        """Whether some factor refers to the origin, which is then an additional, fixed vertex, the last one."""
        return bool(self.is_of_origin.any())

    @property
    def _vertices(self) -> Matrix:
        return self._of_vertices(self.poses, of_origin=lie.identity(self.dimension))

    @property
    def _fixed_vertices(self) -> Mask:
        return self._of_vertices(self.fixed, of_origin=True)

    @property
    def _is_point_vertex(self) -> Mask:
        return self._of_vertices(self.is_point, of_origin=False)

    @property
    def _joined(self) -> Integers:
        """Pairs of vertices that the edges join, (E, 2)."""
        return np.where(self.edges == ORIGIN, len(self), self.edges) if self._has_origin else self.edges

    def _of_vertices(self, of_poses: NDArray[Any], of_origin: object) -> NDArray[Any]:
        """Values of the poses (K, ...), with that of the origin appended where the graph has it."""
        return np.concatenate([of_poses, np.asarray(of_origin)[None]]) if self._has_origin else of_poses

    @property
    def _weight_in_force(self) -> Vector:
        return self.weight * ~self.is_rejected

    def _in_force(self, chi2: Vector) -> float:
        """The sum of w χ² over the edges in force; χ² (E,)."""
        return float((self.weight * chi2)[~self.is_rejected].sum())

    def _changed(self) -> None:
        self._problem, self._factor_is_now = None, False


def _refused(undetermined: str) -> InputError:
    return InputError(
        f"pose graph: {undetermined}; give their edges full information matrices, fix them or leave them out"
    )
