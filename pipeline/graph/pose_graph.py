"""The pose graph: keyframe poses and the relative poses measured between them, grown one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.clock import working_s
from pipeline.config import GraphConfig
from pipeline.data import GraphState, Matrix, Pose
from pipeline.errors import InputError
from pipeline.graph.between import BetweenProblem
from pipeline.graph.certificate import Certificate, certify
from pipeline.graph.cholesky import SingularMatrixError
from pipeline.graph.covariance import own_covariances, relative_covariance
from pipeline.graph.graduation import Judgement
from pipeline.graph.growing_array import GrowingArray
from pipeline.graph.initialise import Initialisation
from pipeline.graph.optimisation import Optimisation
from pipeline.graph.solve import solve
from pipeline.graph.soundness import check_connected, check_edges, undetermined


class PoseGraph:
    """Poses T_world_lidar and between factors T_ij (frame j seen from frame i) with e = log(T_ij⁻¹ T_i⁻¹ T_j).

    The gauge is fixed by holding pose 0, or those given to ``fix``, where they are.
    """

    def __init__(self, dimension: int) -> None:
        """Make an empty graph of SE(2) (dimension 2) or SE(3) (3) poses."""
        self.dimension = dimension
        self.freedom = 3 if dimension == 2 else 6
        pose, k = (dimension + 1, dimension + 1), self.freedom
        self._poses, self._stamps_ns = GrowingArray(pose, np.float64), GrowingArray((), np.int64)
        self._edges, self._measurements = GrowingArray((2,), np.int64), GrowingArray(pose, np.float64)
        self._information, self._is_loop = GrowingArray((k, k), np.float64), GrowingArray((), np.bool_)
        self._weight, self._is_point = GrowingArray((), np.float64), GrowingArray((), np.bool_)
        self._fixed: set[int] = set()
        self._problem: BetweenProblem | None = None
        self._factor_is_now = False

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> Matrix:
        """T_world_lidar of every pose, (K, d+1, d+1)."""
        return self._poses.rows

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamp of every pose, (K,)."""
        return self._stamps_ns.rows

    @property
    def edges(self) -> NDArray[np.int64]:
        """Pose pairs (i, j), (E, 2), in the order they were added."""
        return self._edges.rows

    @property
    def measurements(self) -> Matrix:
        """T_ij of every edge, (E, d+1, d+1)."""
        return self._measurements.rows

    @property
    def information(self) -> Matrix:
        """Ω of every edge, (E, k, k)."""
        return self._information.rows

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """Whether the robust loss applies to the edge, (E,)."""
        return self._is_loop.rows

    @property
    def weight(self) -> NDArray[np.float64]:
        """Weight that the last optimisation left to every edge, (E,); 1 before."""
        return self._weight.rows

    @property
    def is_point(self) -> NDArray[np.bool_]:
        """Which poses are points, without a heading, (K,)."""
        return self._is_point.rows

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Which poses are held, (K,); pose 0 where none was named."""
        held = np.zeros(len(self), np.bool_)
        held[sorted(self._fixed) or slice(0, 1)] = True
        return held

    @property
    def held(self) -> list[int]:
        """Poses held by name through ``fix``, ascending."""
        return sorted(self._fixed)

    def add_pose(self, T_world: Pose, stamp_ns: int) -> int:
        """Index of the new pose, with this first guess."""
        return self._append(T_world, stamp_ns, is_point=False)

    def add_point(self, position: NDArray[np.float64], stamp_ns: int) -> int:
        """Index of a new point of the plane (2,): it counts among the poses, with the identity as its rotation."""
        return self._append(lie.pose_2d(position[0], position[1], 0.0), stamp_ns, is_point=True)

    def add_edge(self, i: int, j: int, T_ij: Pose, information: Matrix, is_loop: bool = False) -> None:
        """Add a measurement of frame j in frame i.

        information (k, k) is the inverse covariance of e = log(T_ij⁻¹ T_i⁻¹ T_j), a right twist on T_ij; what a
        matcher says about left twists becomes that by ``right_information``. Loops get the robust loss.
        """
        self.add_edges(np.array([[i, j]]), T_ij[None], information[None], np.array([is_loop]))

    def add_edges(
        self, edges: NDArray[np.int64], measurements: Matrix, information: Matrix, is_loop: NDArray[np.bool_]
    ) -> None:
        """Add many edges: (E, 2), (E, d+1, d+1), (E, k, k), (E,)."""
        check_edges(edges, measurements, information, len(self))
        self._changed()
        self._edges.extend(edges)
        self._measurements.extend(measurements)
        self._information.extend(information)
        self._is_loop.extend(is_loop)
        self._weight.extend(np.ones(len(edges)))

    def add_sightings(self, edges: NDArray[np.int64], positions: NDArray[np.float64], information: Matrix) -> None:
        """Add points as poses see them: edges (E, 2) pose and point, positions (E, 2) there, Ω (E, 2, 2)."""
        measurements = np.tile(lie.identity(2), (len(edges), 1, 1))
        measurements[:, :2, 2] = positions
        padded = np.zeros((len(edges), 3, 3))
        padded[:, :2, :2] = information
        self.add_edges(edges, measurements, padded, np.zeros(len(edges), np.bool_))

    def fix(self, index: int) -> None:
        """Hold this pose where it is, instead of pose 0."""
        if not 0 <= index < len(self):
            raise InputError(f"pose {index} cannot be fixed: the graph has {len(self)} poses; add it first")
        self._changed()
        self._fixed.add(index)

    def optimise(
        self, config: GraphConfig, *, initialise: Initialisation = "auto", judgement: Judgement = "mended"
    ) -> Optimisation:
        """Move the poses to the minimum of χ², starting from the chosen guess.

        judgement : of loop edges under the truncated loss; "graduated" is good enough on the way and cheaper
        """
        begin = working_s()
        problem = self._prepared()
        chi2_before = float(problem.chi2(problem.errors(self.poses)).sum())
        solved = solve(problem, self.poses, self.is_loop, config, initialise, judgement)
        minimum = solved.minimum
        self._poses.replace(solved.poses)
        self._weight.replace(minimum.weights)
        self._factor_is_now = False
        return Optimisation(
            state=self.state(),
            chi2_before=chi2_before,
            chi2_after=float(minimum.estimate.chi2.sum()),
            cost_after=minimum.estimate.cost,
            rejected=solved.rejected[self._order()],
            iterations=minimum.iterations,
            converged=minimum.converged,
            reason=minimum.reason,
            initialisation=solved.initialisation,
            time_s=working_s() - begin,
        )

    def certify(self) -> Certificate:
        """Whether the poses are the global minimum of χ², edges weighed as the last optimisation left them."""
        return certify(self._prepared(), self.poses, self.weight)

    def state(self) -> GraphState:
        """The graph as it is, for those who show or write it; odometry edges first."""
        order, problem = self._order(), self._prepared()
        chi2 = problem.chi2(problem.errors(self.poses))
        return GraphState(
            poses=self.poses,
            stamps_ns=self.stamps_ns,
            edges=self.edges[order],
            is_loop=self.is_loop[order],
            weight=self.weight[order],
            chi2=float(chi2.sum()),
            edge_chi2=chi2[order],
        )

    def relative_covariance(self, i: int, j: int) -> Matrix:
        """Covariance (k, k) of a left twist on T_i⁻¹ T_j, given all edges at the poses and weights of now.

        The factor of H is kept until the graph changes, so that each further pair costs k solves.
        """
        return relative_covariance(self._factored(), self.poses, i, j)

    def covariances(self) -> Matrix:
        """Covariance (K, k, k) of every pose's twist in its own frame, given all edges at the poses of now."""
        return own_covariances(self._factored(), self.poses)

    def _append(self, T_world: Pose, stamp_ns: int, *, is_point: bool) -> int:
        if not np.isfinite(T_world).all():
            raise InputError(f"pose {len(self)} is not finite; give it a first guess or leave it out")
        self._changed()
        self._stamps_ns.append(stamp_ns)
        self._is_point.append(is_point)
        return self._poses.append(T_world)

    def _factored(self) -> BetweenProblem:
        """The problem, with the factor of the undamped H in its solver."""
        problem = self._prepared()
        if not self._factor_is_now:
            equations = problem.linearise(self.poses, problem.errors(self.poses), self.weight)
            try:
                problem.cholesky.factorise(equations.values)
            except SingularMatrixError as error:
                raise undetermined(int(problem.free[error.variable])) from error
            self._factor_is_now = True
        return problem

    def _prepared(self) -> BetweenProblem:
        """The least-squares problem; built anew after the graph has grown."""
        if self._problem is None:
            fixed = self.fixed
            check_connected(self.edges, fixed)
            self._problem = BetweenProblem(self.edges, self.measurements, self.information, fixed, self.is_point)
        return self._problem

    def _order(self) -> NDArray[np.int64]:
        """Edges with odometry first, otherwise as they were added."""
        return np.argsort(self.is_loop, kind="stable")

    def _changed(self) -> None:
        self._problem, self._factor_is_now = None, False
