"""Closures in columns come back as they were."""

from dataclasses import fields, replace

import numpy as np
import pytest

from scanchain.data import Closure, ClosureVerdict, Match, Problem, Proposal
from scanchain.loops import ClosureTable


def closures(k):
    rng = np.random.default_rng(k)
    size = 3 if k == 3 else 4
    for source in range(40):
        match = Match(
            T_target_source=rng.normal(size=(size, size)),
            information=rng.normal(size=(k, k)),
            cost=rng.normal(),
            inliers=source,
            points=2 * source,
            iterations=source % 7,
            residual_m=rng.normal(),
            fit=rng.normal(),
            at_minimum=source % 2 == 0,
            converged=source % 3 == 0,
            reason=f"reason {source % 5}",
            degeneracy_eigenvalue=rng.normal(),
            observability=np.inf,
            degeneracy_direction=rng.normal(size=k),
            cause=f"cause {source % 3}",
        )
        verdict = ClosureVerdict.REJECTED if source % 4 else ClosureVerdict.ACCEPTED
        cause, reason = f"overlap {source % 2}", f"overlap {source % 6}"
        yield Closure(source // 2, source, match, rng.random(), verdict, reason, Proposal.PLACE, cause=cause)


def same(a, b):
    return type(a) is type(b) and all(
        same(x, y) if isinstance(x, Match) else type(x) is type(y) and np.array_equal(x, y)
        for x, y in ((getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    )


@pytest.mark.parametrize("k", [3, 6])
def test_closures_come_back_bit_by_bit_and_in_their_types(k):
    given = [replace(each, chi2_before=float(each.source), chi2_after=1.0) for each in closures(k)]
    table = ClosureTable()
    table.extend(given[:17])
    table.extend(given[17:])
    assert len(table) == len(given)
    assert all(same(a, b) for a, b in zip(given, table, strict=True))
    assert same(table[-1], given[-1]) and [each.source for each in table[3:9:2]] == [3, 5, 7]


def test_an_empty_table_holds_nothing():
    assert not ClosureTable() and list(ClosureTable()) == []
    with pytest.raises(IndexError, match="closure 0 of 0"):
        ClosureTable()[0]


def test_of_closures_some_are_rejected_and_the_others_stay_as_they_are():
    given, table = [replace(each, chi2_before=1.0, chi2_after=2.0) for each in closures(3)], ClosureTable()
    table.extend(given)
    table.reject(lambda each: each.source in (4, 8), Problem("withdrawn", "the place was withdrawn"))
    accepted = [each.source for each in table if each.verdict is ClosureVerdict.ACCEPTED]
    assert accepted == [0, *range(12, 40, 4)]
    assert (table[4].cause, table[8].reason) == ("withdrawn", "the place was withdrawn")
    assert all(same(a, b) for a, b in zip(given, table, strict=True) if a.source not in (4, 8))
