"""Loop closures in columns: all that were tried, without an object for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from typing import Any, overload

import numpy as np

from scanchain.data import Closure, ClosureVerdict, Match, Problem, Proposal
from scanchain.growing_array import Columns

_TEXTS = {"reason": str, "cause": str, "verdict": ClosureVerdict, "proposed_by": Proposal}
_OF_MATCH = [field.name for field in fields(Match)]
_OF_CLOSURE = [field.name for field in fields(Closure) if field.name != "match"]


class ClosureTable(Sequence[Closure]):
    """Closures in a fifth of the memory of their objects, which are created on access."""

    def __init__(self) -> None:
        self._closures, self._matches = Columns(), Columns()

    def __len__(self) -> int:
        return len(self._closures)

    def extend(self, closures: Iterable[Closure]) -> None:
        """Append closures."""
        for closure in closures:
            self._closures.append({name: getattr(closure, name) for name in _OF_CLOSURE})
            self._matches.append({name: getattr(closure.match, name) for name in _OF_MATCH})

    def reject(self, chosen: Callable[[Closure], bool], problem: Problem) -> None:
        """Reject closures that were accepted."""
        kept = [each.rejected(problem) if chosen(each) else each for each in self]
        self._closures, self._matches = Columns(), Columns()
        self.extend(kept)

    @overload
    def __getitem__(self, index: int) -> Closure: ...
    @overload
    def __getitem__(self, index: slice) -> list[Closure]: ...
    def __getitem__(self, index: int | slice) -> Closure | list[Closure]:
        """One closure or some."""
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"closure {index} of {len(self)}")
        match = Match(**_record(self._matches, _OF_MATCH, index))
        return Closure(match=match, **_record(self._closures, _OF_CLOSURE, index))


def _record(columns: Columns, names: Sequence[str], index: int) -> dict[str, Any]:
    values = {name: columns[name][index] for name in names}
    return {
        name: _TEXTS[name](columns.texts[value]) if name in _TEXTS else value if np.ndim(value) else value.item()
        for name, value in values.items()
    }
