"""Loop closures in columns: all that were tried, without an object for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from typing import Any, overload

import numpy as np

from scanchain.data import Closure, ClosureVerdict, Match, Problem, Proposal
from scanchain.graph.growing_array import GrowingArray

_TEXTS = {"reason": str, "cause": str, "verdict": ClosureVerdict, "proposed_by": Proposal}  # kept as numbers


class ClosureTable(Sequence[Closure]):
    """Closures in a fifth of the memory of their objects, which are made where they are asked for."""

    def __init__(self) -> None:
        self._closures: dict[str, GrowingArray] = {}
        self._matches: dict[str, GrowingArray] = {}
        self._codes: dict[str, int] = {}
        self._texts: list[str] = []

    def __len__(self) -> int:
        return len(self._closures["target"]) if self._closures else 0

    def extend(self, closures: Iterable[Closure]) -> None:
        """Append closures."""
        for closure in closures:
            self._append(self._closures, closure)
            self._append(self._matches, closure.match)

    def reject(self, chosen: Callable[[Closure], bool], problem: Problem) -> None:
        """Reject closures that were accepted."""
        kept = [each.rejected(problem) if chosen(each) else each for each in self]
        self._closures, self._matches = {}, {}
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
        return Closure(match=Match(**self._row(self._matches, index)), **self._row(self._closures, index))

    def _append(self, columns: dict[str, GrowingArray], record: Closure | Match) -> None:
        for field in fields(record):
            name, value = field.name, getattr(record, field.name)
            if name == "match":
                continue
            if name in _TEXTS:
                value = self._code(str(value))
            if name not in columns:
                columns[name] = GrowingArray(np.shape(value), np.asarray(value).dtype.type)
            columns[name].append(value)

    def _code(self, text: str) -> int:
        if text not in self._codes:
            self._codes[text] = len(self._texts)
            self._texts.append(text)
        return self._codes[text]

    def _row(self, columns: dict[str, GrowingArray], index: int) -> dict[str, Any]:
        row = {name: column.rows[index] for name, column in columns.items()}
        return {
            name: _TEXTS[name](self._texts[value]) if name in _TEXTS else value if np.ndim(value) else value.item()
            for name, value in row.items()
        }
