"""Factors: what the edges of a pose graph measure. A new kind is a class here and a line in ``FACTORS``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scanchain import checks, lie
from scanchain.data import Integers, Mask, Matrix, Pose
from scanchain.errors import InputError
from scanchain.growing_array import read_only
from scanchain.kernels.graph import between

ORIGIN = -1  # index i of a unary edge: the origin of the world, which is fixed
LARGEST_SIGMAS = (300.0, 30.0)  # m and rad, largest of an edge: with less information a pose is lost to rounding
_STEP = 1e-6  # m or rad, step of central differences: of the order of the cube root of machine epsilon


class Factor:
    """A kind of edge: the residual e(T_ij, Z) of the relative pose T_ij = T_i⁻¹ T_j and its measurement Z.

    A custom factor defines ``name`` and ``error``, and ``jacobian`` if it should be exact, and is added to a graph
    by ``PoseGraph.add_factor``.

    name : shown in messages; is_robust : whether edges have the robust loss, so that they can be rejected
    """

    name: str = "factor"
    is_robust: bool = False

    def error(self, T_ij: Matrix, Z: Matrix) -> Matrix:
        """Residuals (E, m), m up to the degrees of freedom of a pose, of relative poses (E, d+1, d+1)."""
        raise NotImplementedError(f"{type(self).__name__}.error(T_ij, Z) is missing")

    def jacobian(self, T_ij: Matrix, Z: Matrix) -> Matrix:
        """∂e/∂ξ (E, m, k) for right twists, T_ij exp(ξ); by central differences."""
        k = lie.twist_size(T_ij)
        ahead, behind = (lie.exp(sign * _STEP * np.eye(k)) for sign in (1.0, -1.0))
        columns = [
            (self.error(T_ij @ ahead[axis], Z) - self.error(T_ij @ behind[axis], Z)) / (2.0 * _STEP)
            for axis in range(k)
        ]
        return np.stack(columns, axis=-1)

    def check(self, T_ij: Pose, Z: Pose, count: int) -> None:
        """Raise InputError if the residuals at a pose are not ``count`` finite numbers."""
        found = np.asarray(self.error(np.stack([T_ij, T_ij]), np.stack([Z, Z])))
        if found.shape != (2, count) or not np.isfinite(found).all():
            wanted = f"finite numbers of the shape (2, {count}) for two poses, as information is {count} x {count}"
            raise InputError(f"{type(self).__name__}.error returned {found.tolist()}; wanted {wanted}")

    def residual(self, poses: Matrix, edges: Integers, Z: Matrix) -> Matrix:
        """Residuals e (E, k) of edges (E, 2) that measure Z (E, d+1, d+1), at these poses; zero from m on."""
        error = self.error(lie.between(*poses[edges.T]), Z)
        errors = np.zeros((len(edges), lie.twist_size(poses)))
        errors[:, : error.shape[1]] = error
        return errors

    def linearize(self, poses: Matrix, edges: Integers, Z: Matrix, errors: Matrix) -> Matrix:
        """∂e/∂ξ_j (E, k, k) for left twists, T_j ← exp(ξ_j) T_j, where the residuals are these errors (E, k).

        Since e depends on T_i⁻¹ T_j alone, the same left twist of both poses changes nothing, and
        ∂e/∂ξ_i = −∂e/∂ξ_j.
        """
        T_i, T_j = poses[edges.T]
        of_error = self.jacobian(lie.between(T_i, T_j), Z) @ lie.adjoint(lie.inverse(T_j))
        jacobian = np.zeros((*errors.shape, errors.shape[1]))
        jacobian[:, : of_error.shape[1]] = of_error
        return jacobian


class Between(Factor):
    """e = log(Z⁻¹ T_i⁻¹ T_j): the right twist from the measurement to the relative pose, T_i⁻¹ T_j = Z exp(e)."""

    def error(self, T_ij: Matrix, Z: Matrix) -> Matrix:
        """See ``Factor``."""
        return lie.log(lie.between(Z, T_ij))

    def residual(self, poses: Matrix, edges: Integers, Z: Matrix) -> Matrix:
        """See ``Factor``; compiled."""
        errors = np.empty((len(edges), lie.twist_size(poses)))
        residuals = between.residuals_2d if errors.shape[1] == 3 else between.residuals_3d
        residuals(read_only(poses), read_only(edges), read_only(Z), errors)
        return errors

    def linearize(self, poses: Matrix, edges: Integers, Z: Matrix, errors: Matrix) -> Matrix:
        """See ``Factor``; compiled."""
        jacobian = np.empty((*errors.shape, errors.shape[1]))
        if errors.shape[1] == 3:
            between.jacobians_2d(read_only(poses), read_only(edges), read_only(Z), jacobian)
        else:
            between.jacobians_3d(read_only(poses), read_only(edges), errors, jacobian)
        return jacobian


class Odometry(Between):
    """The motion between successive poses."""

    name = "odometry"


class Loop(Between):
    """The relative pose at a revisit, which may be an outlier."""

    name = "loop"
    is_robust = True


class Position(Factor):
    """e = R_zᵀ(R_iᵀ(t_j − t_i) − t_z): the position of j in frame i, whatever its rotation, as in g2o."""

    name = "position"

    def error(self, T_ij: Matrix, Z: Matrix) -> Matrix:
        """See ``Factor``."""
        d = Z.shape[-1] - 1
        return ((T_ij[:, None, :d, d] - Z[:, None, :d, d]) @ Z[:, :d, :d])[:, 0]

    def residual(self, poses: Matrix, edges: Integers, Z: Matrix) -> Matrix:
        """See ``Factor``; computed without the rotation of j."""
        d, (T_i, T_j) = poses.shape[-1] - 1, poses[edges.T]
        seen = (T_j[:, None, :d, d] - T_i[:, None, :d, d]) @ T_i[:, :d, :d]
        errors = np.zeros((len(edges), lie.twist_size(poses)))
        errors[:, :d] = ((seen - Z[:, None, :d, d]) @ Z[:, :d, :d])[:, 0]
        return errors

    def linearize(self, poses: Matrix, edges: Integers, Z: Matrix, errors: Matrix) -> Matrix:
        """R_zᵀ R_iᵀ [I, ∂t_j/∂φ]."""
        d, (T_i, T_j) = poses.shape[-1] - 1, poses[edges.T]
        R_t = np.swapaxes(T_i[:, :d, :d] @ Z[:, :d, :d], 1, 2)
        jacobian = np.zeros((*errors.shape, errors.shape[1]))
        jacobian[:, :d, :d], jacobian[:, :d, d:] = R_t, R_t @ turns(T_j[:, :d, d])
        return jacobian


class Prior(Between):
    """The whole pose in the world."""

    name = "prior"


class RobustPrior(Prior):
    """The whole pose in the world, which may be an outlier."""

    is_robust = True


class RobustPosition(Position):
    """The position in the world, which may be an outlier, as of GNSS."""

    is_robust = True


class Sighting(Position):
    """The position of a point, or of a pose, seen from another pose."""

    name = "sighting"


class LoopSighting(Sighting):
    """The position at a revisit: a loop that measures no rotation."""

    name = "loop"
    is_robust = True


FACTORS: tuple[Factor, ...] = (
    Odometry(), Loop(), Sighting(), LoopSighting(), Prior(), Position(), RobustPrior(), RobustPosition(),
)  # fmt: skip


def _kinds(*classes: type[Factor]) -> tuple[int, ...]:
    """Kinds of edges, indices in the table, whose factors are of these classes."""
    return tuple(kind for kind, factor in enumerate(FACTORS) if isinstance(factor, classes))


ODOMETRY, LOOP, SIGHTING, LOOP_SIGHTING = RELATIVE = range(4)  # kinds of edges between poses
LOOPS, SIGHTINGS = _kinds(Loop, LoopSighting), _kinds(Sighting)
WHOLE = _kinds(Between)  # those that measure position and rotation


def kinds_of(edges: Integers, information: Matrix, is_point: Mask, is_loop: Mask | bool = False) -> Integers:
    """Kind (E,) of edges between poses: those to points, or whose Ω (E, k, k) has no rotation, are sightings.

    is_point : (K,) of the poses; is_loop : (E,), by default none
    """
    d = 2 if information.shape[-1] == 3 else 3
    is_sighting = is_point[edges].any(axis=1) | ~information[:, d:].any(axis=(1, 2))
    return np.where(is_sighting, np.where(is_loop, LOOP_SIGHTING, SIGHTING), np.where(is_loop, LOOP, ODOMETRY))


def of_residuals(information: ArrayLike, freedom: int, factor: Factor) -> Matrix:
    """Ω (k, k) of a factor: the information (m, m) of its m residuals, padded with zeros."""
    shape = np.shape(information)
    count = shape[0] if shape else 0
    if not 0 < count <= freedom:
        wanted = f"(m, m) for the m residuals of {factor.name}, 1 to {freedom}"
        raise InputError(f"information has the shape {shape}; wanted {wanted}")
    result = np.zeros((freedom, freedom))
    result[:count, :count] = checks.matrices(information, "information", (count, count))
    return result


def edge_information(information: Matrix, sigma_m: float, sigma_rad: float) -> Matrix:
    """Information (k, k) of a pose-graph edge: that of the motion (k, k), with a floor under its variances.

    Residuals share the map's errors and are far from independent, so that H alone is overconfident.
    """
    k = len(information)
    largest = lie.by_component(k, *LARGEST_SIGMAS) ** 2
    floor = np.minimum(lie.by_component(k, sigma_m, sigma_rad) ** 2, largest)
    least = np.maximum(1e-6 / floor, 1.0 / largest)
    covariance = np.linalg.inv(information + np.diag(least)) + np.diag(floor)
    result = np.linalg.inv(covariance)
    return 0.5 * (result + result.T)


def turns(positions: Matrix) -> Matrix:
    """∂t/∂φ (E, d, 1 or 3) of positions (E, d) turned about the origin."""
    if positions.shape[1] == 3:
        return -lie.hat(positions)
    return np.stack([-positions[:, 1], positions[:, 0]], axis=1)[..., None]
