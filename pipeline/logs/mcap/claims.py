"""What an MCAP file says of itself, against what has been found in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from scanchain.logs.mcap.records import FileIndex
from scanchain.words import counted


def check_claims(index: FileIndex, chunks_told: int, private: Sequence[int]) -> None:
    """Trust what blocks say about their channels where it adds up to the statistics; note what does not.

    chunks_told : by the statistics; private : where records of unknown kinds lie
    """
    totals: Counter[int] = Counter()
    for entry in (entry for block in index.blocks for entry in block.entries):
        totals[entry.channel] += entry.messages
    told = {number: count for number, count in index.counts.items() if count}
    chunks = sum(block.is_chunk for block in index.blocks)
    index.is_trusted = index.is_counted and told == dict(totals) and chunks == chunks_told
    is_indexed = all(block.entries for block in index.blocks)
    if index.is_counted and not index.is_trusted and (is_indexed or chunks != chunks_told):
        index.damage.append(
            f"{index.path}: its {counted(chunks, 'chunk')} and {counted(totals.total(), 'indexed message')} "
            f"are not the {chunks_told} and {sum(told.values())} of its statistics"
        )
    if private and not index.is_counted:  # nothing tells whether one of them was a chunk
        index.damage.append(
            f"{index.path}: passed over {counted(len(private), 'record')} of unknown kinds, "
            f"the first at byte {private[0]}"
        )
