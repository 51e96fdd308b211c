"""The table of the course report, every method in one run: python -m tests.benchmarks.solvers.

Each round solves every problem by every method in turn; times are medians of whole solutions of A x = b, a new
solver each time; "again" is with the same solver once more, which keeps what it found out about the pattern. The
report's seconds are of another machine (and its QR is SuiteSparseQR): ratios within a column compare.
"""

import argparse
from pathlib import Path

import numpy as np

from scanchain.landmarks.files import read_landmark_data
from scanchain.landmarks.problem import linear_system
from scanchain.landmarks.solvers import METHODS, compare

ROOT = Path(__file__).resolve().parents[2]
OF_THE_REPORT = ("default", "pinv", "lu", "lu_colamd", "qr", "qr_colamd")
REPORT_S = {
    "2d_linear": (0.04870, 1.1802, 0.0260, 0.1152, 0.3671, 0.2509),
    "2d_linear_loop": (0.0054, 0.1629, 0.0295, 0.0087, 0.2487, 0.0190),
}
AGREEMENT = 1e-8


def with_suitesparse():
    try:
        import sparseqr  # noqa: F401
    except ImportError:
        return METHODS
    return (*METHODS, "spqr", "spqr_colamd")


def report(name, results):
    published = dict(zip(OF_THE_REPORT, REPORT_S[name], strict=True))
    print(f"\n{name}")
    print(f"  {'method':12} {'report s':>9} {'total ms':>9} {'build':>8} {'factor':>8} {'solve':>7}"
          f" {'again ms':>9} {'nnz factor':>11} {'differs by':>10}")  # fmt: skip
    for result in results:
        told = f"{published[result.method]:9.4f}" if result.method in published else f"{'-':>9}"
        build, factor, solve, again = (
            1e3 * seconds for seconds in (result.build_s, result.factor_s, result.solve_s, result.again_s)
        )
        print(f"  {result.method:12} {told} {1e3 * result.total_s:9.2f} {build:8.2f} {factor:8.2f} {solve:7.2f}"
              f" {again:9.2f} {result.factor.nnz:11,} {result.difference:10.1e}")  # fmt: skip
    spread = max(float(np.abs(a.x - b.x).max()) for a in results for b in results)
    print(f"  all agree to {spread:.1e}" + ("" if spread <= AGREEMENT else f": MORE THAN {AGREEMENT:g}"))
    fastest = min((result for result in results if result.method in OF_THE_REPORT), key=lambda r: r.total_s)
    for result in results:
        if result.method in ("cholesky", "schur"):
            print(f"  {result.method}: {fastest.total_s / result.total_s:.1f} × as fast as {fastest.method},"
                  f" {fastest.total_s / result.again_s:.1f} × with its analysis kept")  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "landmarks")
    options = parser.parse_args()
    for name in REPORT_S:
        system = linear_system(read_landmark_data(options.data / f"{name}.npz"))
        report(
            name, compare(lambda solver, system=system: solver.solve(system), with_suitesparse(), options.repeats)
        )


if __name__ == "__main__":
    main()
