"""Pose-graph optimization against GTSAM on the published graphs, interleaved.

Each method optimizes what it has read; reading is not timed, building the problem and the first guess are. GTSAM
runs from the file's guess and from its own (chordal in 3D; LAGO in 2D, which takes diagonal information only and
gets the diagonal), with Gauss-Newton and with Levenberg-Marquardt. All ½χ² are evaluated by the same code:
½ Σ eᵀΩe with e = log(Z⁻¹ T_i⁻¹ T_j).
"""

import time
from dataclasses import dataclass

import gtsam
import numpy as np

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.g2o import read_g2o, write_g2o
from scanchain.graph.problem import GraphProblem
from tests.benchmarks.harness import options_of, table
from tests.support.graphs import BEST
from tests.support.scenes import DATA

SHORT = (("LM", "levenberg-marquardt"), ("GN", "gauss-newton"))
GRAPHS = ["manhattan", "intel", "MIT", "smallGrid3D", "sphere2500", "torus3D"]
SLOW_S = 2.0  # of a method that is run once only


@dataclass
class Run:
    """One method on one graph: its times, and where it ended."""

    seconds: list[float]
    iterations: int = 0
    half_chi2: float = float("nan")
    failure: str = ""


class Ours:
    def __init__(self, path, optimizer):
        self.path, self.config = path, GraphConfig(optimizer=optimizer)

    def run(self):
        graph = read_g2o(self.path).graph
        begin = time.perf_counter()
        answer = graph.optimize(self.config)
        return time.perf_counter() - begin, answer.iterations, graph.poses


class Gtsam:
    """GTSAM on the same file, with vertices written where it has none."""

    def __init__(self, path, optimizer, guess):
        source = read_g2o(path).graph
        self.dimension, self.optimizer, self.guess = source.dimension, optimizer, guess
        self.factors, self.initial = gtsam.readG2o(str(path), self.dimension == 3)
        if not self.initial.size():
            raise ValueError(f"{path} has no vertices")
        sigmas = np.full(source.freedom, 1e-6)
        self.prior_type = gtsam.PriorFactorPose2 if self.dimension == 2 else gtsam.PriorFactorPose3
        self.first = self.initial.atPose2(0) if self.dimension == 2 else self.initial.atPose3(0)
        self.noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        self.for_lago = gtsam.NonlinearFactorGraph()
        if self.dimension == 2 and guess == "own":
            for (i, j), Z, omega in zip(source.edges, source.measurements, source.information, strict=True):
                noise = gtsam.noiseModel.Diagonal.Precisions(np.diag(omega))
                self.for_lago.add(
                    gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*Z[:2, 2], float(lie.yaw(Z))), noise)
                )
            self.for_lago.add(self.prior_type(0, self.first, self.noise))

    def run(self):
        factors = self.factors.clone()
        begin = time.perf_counter()
        factors.add(self.prior_type(0, self.first, self.noise))
        initial = self.initial
        if self.guess == "own":
            flat = self.dimension == 2
            initial = gtsam.lago.initialize(self.for_lago) if flat else gtsam.InitializePose3.initialize(factors)
        if self.optimizer == "gauss-newton":
            solver = gtsam.GaussNewtonOptimizer(factors, initial, gtsam.GaussNewtonParams())
        else:
            solver = gtsam.LevenbergMarquardtOptimizer(factors, initial, gtsam.LevenbergMarquardtParams())
        values = solver.optimize()
        seconds = time.perf_counter() - begin
        at = values.atPose2 if self.dimension == 2 else values.atPose3
        return seconds, solver.iterations(), np.array([at(key).matrix() for key in range(values.size())])


def half_chi2(path, poses):
    graph = read_g2o(path).graph
    problem = GraphProblem(graph.edges, graph.measurements, graph.information, graph.fixed)
    return 0.5 * float(problem.chi2(problem.errors(lie.inverse(poses[0]) @ poses)).sum())


def compare(path, repeats):
    """Runs of every method, one after the other, ``repeats`` times; a slow one (or one that fails) only once."""
    methods = {f"ours {short}": Ours(path, name) for short, name in SHORT}
    for guess in ("file", "own"):
        for short, name in SHORT:
            methods[f"gtsam {short} from {guess}"] = Gtsam(path, name, guess)
    runs = {name: Run([]) for name in methods}
    for _ in range(repeats):
        for name, method in methods.items():
            run = runs[name]
            if run.failure or (run.seconds and run.seconds[0] > SLOW_S):
                continue
            try:
                seconds, run.iterations, poses = method.run()
            except (RuntimeError, ValueError) as error:
                run.failure = str(error).strip().splitlines()[0][:60] or "failed"
                continue
            run.half_chi2 = half_chi2(path, poses)
            run.seconds.append(seconds)
    return runs


def report(name, runs):
    best = min(run.half_chi2 for run in runs.values() if run.seconds)
    print(f"\n{name}: best known ½χ² {BEST.get(name, '-')}")
    row = table("method", "median ms", "min ms", "iterations", "½χ²", "")
    for method, run in runs.items():
        if run.failure:
            row(method, f"failed: {run.failure}")
            continue
        milliseconds = 1e3 * np.array(run.seconds)
        note = "" if run.half_chi2 <= best * (1.0 + 1e-4) else "not the minimum"
        times = f"{np.median(milliseconds):.1f}", f"{milliseconds.min():.1f}"
        row(method, *times, run.iterations, f"{run.half_chi2:.4f}", note)
    right = [
        r for m, r in runs.items() if m.startswith("gtsam") and r.seconds and r.half_chi2 <= best * (1 + 1e-4)
    ]
    ours = np.median(runs["ours LM"].seconds)
    if right:
        theirs = min(np.median(run.seconds) for run in right)
        print(f"  GTSAM's fastest that reaches it takes {theirs / ours:.1f} × our LM")
    else:
        print("  GTSAM does not reach it")
    damped = runs["gtsam LM from file"]
    if damped.seconds and damped.half_chi2 > best * (1.0 + 1e-4):
        times = np.median(damped.seconds) / ours
        print(f"  GTSAM's LM from the file takes {times:.0f} × our LM and ends in another minimum")


def certify(path):
    """How long the certificate takes, beside the optimization, and what it says."""
    graph = read_g2o(path).graph
    answer = graph.optimize(GraphConfig())
    certificate = graph.certify()
    share = certificate.time_s / answer.time_s
    print(
        f"  certificate: {certificate.verdict}; {1e3 * certificate.time_s:.0f} ms, {share:.2f} × the optimization"
    )


def main():
    options = options_of(__doc__, "graphs", graphs=GRAPHS, repeats=5)
    options.cache.mkdir(parents=True, exist_ok=True)
    for path in (DATA / "graphs" / f"{name}.g2o" for name in options.graphs):
        for _, warm in SHORT:
            graph = read_g2o(path).graph
            graph.optimize(GraphConfig(optimizer=warm))
            graph.certify()
        file, used = read_g2o(path), path
        if not file.has_guess:  # GTSAM needs vertices: give it the odometry, as ours gets
            used = options.cache / f"{path.stem}_with_vertices.g2o"
            write_g2o(used, file.graph)
        report(path.stem, compare(used, options.repeats))
        certify(used)


if __name__ == "__main__":
    main()
