"""Loop closures that are wrong, to be found out by the back end."""

from dataclasses import replace

import numpy as np

from scanchain.data import ClosureVerdict

MADE_UP = "made up"  # the reason that is given for them


def false_closures(slam, share, seed=0):
    """So many that they are this share of all: two keyframes at random, the relative pose of another closure.

    Real ones that happen to be nearly right (within 1 m of what the graph says) are drawn again.
    """
    rng = np.random.default_rng(seed)
    true = [closure for closure in slam.closures if closure.verdict is ClosureVerdict.ACCEPTED]
    wrong = []
    while len(wrong) < share / (1.0 - share) * len(true):
        target, source = np.sort(rng.choice(len(slam.keyframes), 2, replace=False))
        model = true[rng.integers(len(true))]
        here = slam.graph.poses[target] @ model.match.T_target_source
        if np.linalg.norm((here - slam.graph.poses[source])[:-1, -1]) > 1.0:
            wrong.append(replace(model, target=int(target), source=int(source), reason=MADE_UP))
    return tuple(wrong)
