"""Damage done to MCAP files on purpose, and which of their scans no damage has touched."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from functools import cache

import lz4.frame
import numpy as np
import zstandard

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 3, 4, 5, 6, 11, 15
LIES = (0, 1, 8, 2**31 - 1, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
WORDS = (b"nan", b"-inf", b"-1", b"0", b"1e400", b"9" * 30, b"", b"x", b"1_0", "\u0663".encode(), b"\0", b"1e18")
BOMB_BYTES = 900_000_000


@dataclass
class Record:
    """A record at the top level of a file, from ``begin`` to ``end``; the log times of the scans in it."""

    opcode: int
    begin: int
    end: int
    times_ns: set[int] = field(default_factory=set)
    defines: bool = False

    def is_touched(self, touched):
        return any(begin < self.end and end > self.begin for begin, end in touched)


@dataclass
class Mutant:
    """A damaged file, what was done to it, and the bytes of the healthy one that were touched.

    ``is_seamless`` where a whole chunk is gone from a file that counts its chunks nowhere: nothing can tell.
    """

    data: bytes
    what: str
    touched: list[tuple[int, int]]
    is_seamless: bool = False


def mutant(seed, rng):
    """A file damaged in one or several ways."""
    kinds = (flipped, overwritten, cut, lying, lying, lying, spliced, bombed)
    kind = int(rng.integers(len(kinds)))
    return kinds[kind](seed.data if kind < 3 else seed, rng)


def any_mutant(data, rng):
    """A file of whatever format damaged in one way."""
    kinds = (
        flipped, flipped, overwritten, cut, lying_anywhere, left_out, repeated, misspelt, emptied, other_field,
        other_field, without_page, concatenated, swapped,
    )  # fmt: skip
    return kinds[rng.integers(len(kinds))](data, rng)


def flipped(whole, rng):
    data = bytearray(whole)
    places = rng.integers(min(8, len(data) - 1), len(data), rng.integers(1, 9)).tolist()
    for at in places:
        data[at] ^= 1 << rng.integers(8)
    return Mutant(bytes(data), f"bits flipped at {places}", [(at, at + 1) for at in places])


def overwritten(whole, rng):
    begin = int(rng.integers(min(8, len(whole) - 1), len(whole)))
    filling = (bytes(64), b"\xff" * 64, rng.bytes(64), MAGIC * 8)[rng.integers(4)][: rng.integers(1, 65)]
    end = min(begin + len(filling), len(whole))
    data = whole[:begin] + filling[: end - begin] + whole[end:]
    return Mutant(data, f"bytes {begin} to {end} overwritten with {filling[:8]!r}...", [(begin, end)])


def lying(seed, rng):
    """A number in the head of some record is another: its opcode, length, or any number behind."""
    record = seed.records[rng.integers(len(seed.records))]
    size = int(rng.choice([1, 2, 4, 8]))
    offset = int(rng.choice([0, 1, 9, 11, 13, 17, 25, 33, 37, 41, 45]))
    at = min(record.begin + offset, len(seed.data) - size)
    true = int.from_bytes(seed.data[at : at + size], "little")
    near = [true + 1, true - 1, 2 * true, true // 2, true + len(seed.data) // 2]
    value = int(rng.choice(near) if rng.integers(2) else LIES[rng.integers(len(LIES))]) % (1 << 8 * size)
    data = seed.data[:at] + value.to_bytes(size, "little") + seed.data[at + size :]
    return Mutant(data, f"{size} bytes at {at} say {value} instead of {true}", [(at, at + size)])


def spliced(seed, rng):
    """Bytes or whole records left out, written twice, or moved in from elsewhere."""
    if rng.integers(2):
        begin, end = sorted(int(at) for at in rng.integers(8, len(seed.data), 2))
        end = min(end, begin + 500)
    else:
        record = seed.records[rng.integers(len(seed.records))]
        begin, end = record.begin, record.end
    piece = seed.data[begin:end]
    if rng.integers(2):
        what = f"bytes {begin} to {end} left out"
        seamless = not seed.is_summarized and any(record.begin == begin for record in seed.records)
        return Mutant(seed.data[:begin] + seed.data[end:], what, [(begin, end)], seamless)
    at = int(rng.integers(8, len(seed.data))) if rng.integers(2) else end
    data = seed.data[:at] + piece + seed.data[at:]
    return Mutant(data, f"bytes {begin} to {end} written once more at {at}", [(at - 1, at + 1)])


def cut(whole, rng):
    return cut_at(whole, int(rng.integers(1, max(2, len(whole)))))


def cut_at(whole, length):
    return Mutant(whole[:length], f"cut off at byte {length}", [(length, len(whole))])


def cut_and_flipped(whole, rng, longest):
    """A beginning of a file, at most so long, with bits flipped in it."""
    cut_off = cut_at(whole, int(rng.integers(longest // 4, longest)))
    changed = flipped(cut_off.data, rng)
    return Mutant(changed.data, f"{cut_off.what}, {changed.what}", [*cut_off.touched, *changed.touched])


def emptied(whole, rng):
    return cut_at(whole, 0)


def lying_anywhere(whole, rng):
    """A number of one to eight bytes anywhere is another."""
    size = int(rng.choice([1, 2, 4, 8]))
    at = int(rng.integers(0, max(1, len(whole) - size)))
    value = LIES[rng.integers(len(LIES))] % (1 << 8 * size)
    data = whole[:at] + value.to_bytes(size, "little") + whole[at + size :]
    return Mutant(data, f"{size} bytes at {at} say {value}", [(at, at + size)])


def other_field(whole, rng):
    """A field of a record's head, as ROS 1 has them, has one other byte: an opcode, a connection, a count."""
    fields = list(re.finditer(rb"(op|conn|count|size|ver|time|chunk_\w+|index_pos|compression|topic)=", whole))
    if not fields:
        return flipped(whole, rng)
    at = min(fields[rng.integers(len(fields))].end() + int(rng.choice([0, 0, 0, 1, 4])), len(whole) - 1)
    value = whole[at] ^ int(rng.choice([1, 2, 4, 3, 7, 255]))
    data = whole[:at] + bytes([value]) + whole[at + 1 :]
    return Mutant(data, f"byte {at} of a field is {value} instead of {whole[at]}", [(at, at + 1)])


def without_page(whole, rng):
    """A page of 512 to 4096 bytes is destroyed, as disks lose them."""
    size = int(rng.choice([512, 4096]))
    begin = size * int(rng.integers(max(1, len(whole) // size)))
    end = min(begin + size, len(whole))
    filling = (bytes(size), b"\xff" * size, rng.bytes(size))[rng.integers(3)][: end - begin]
    data = whole[:begin] + filling + whole[end:]
    return Mutant(data, f"page {begin} to {end} is {filling[:4]!r}...", [(begin, end)])


def concatenated(whole, rng):
    """The file once more behind itself, or behind a part of itself."""
    end = len(whole) if rng.integers(2) else int(rng.integers(1, len(whole) + 1))
    return Mutant(whole[:end] + whole, f"bytes 0 to {end} before the file", [(0, len(whole))])


def swapped(whole, rng):
    """Two pieces in each other's place."""
    a, b, c = sorted(int(at) for at in rng.integers(0, len(whole) + 1, 3))
    data = whole[:a] + whole[b:c] + whole[a:b] + whole[c:]
    return Mutant(data, f"bytes {a} to {b} behind those to {c}", [(a, c)])


def left_out(whole, rng):
    begin, end = _piece(whole, rng)
    return Mutant(whole[:begin] + whole[end:], f"bytes {begin} to {end} left out", [(begin, end)])


def repeated(whole, rng):
    """Bytes written once more, somewhere."""
    begin, end = _piece(whole, rng)
    at = int(rng.integers(0, len(whole)))
    data = whole[:at] + whole[begin:end] + whole[at:]
    return Mutant(data, f"bytes {begin} to {end} written once more at {at}", [(at - 1, at + 1)])


def misspelt(whole, rng):
    """A number that is written out is another, or none."""
    words = list(re.finditer(rb"-?\d+(\.\d+)?", whole[:200_000]))
    if not words:
        return flipped(whole, rng)
    word = words[rng.integers(len(words))]
    other = WORDS[rng.integers(len(WORDS))]
    data = whole[: word.start()] + other + whole[word.end() :]
    return Mutant(data, f"{other!r} instead of {word[0]!r} at {word.start()}", [word.span()])


def _piece(whole, rng):
    begin, end = sorted(int(at) for at in rng.integers(0, len(whole) + 1, 2))
    return begin, min(end, begin + 500)


def bombed(seed, rng):
    """A chunk's contents are zeros without end, and its head admits some of them."""
    chunks = [record for record in seed.records if record.opcode == CHUNK]
    if not chunks:
        return flipped(seed.data, rng)
    chunk = chunks[rng.integers(len(chunks))]
    name = ("zstd", "lz4")[rng.integers(2)]
    admitted = int(rng.choice([BOMB_BYTES, 1 << 20, 1 << 25, 1 << 27, 1 << 62]))
    payload = bomb(name)
    head = seed.data[chunk.begin + 9 : chunk.begin + 25] + struct.pack("<QI", admitted, 0)
    body = head + struct.pack("<I", len(name)) + name.encode() + struct.pack("<Q", len(payload)) + payload
    record = struct.pack("<BQ", CHUNK, len(body)) + body
    data = seed.data[: chunk.begin] + record + seed.data[chunk.end :]
    what = f"the chunk at byte {chunk.begin} is a {name} bomb that admits {admitted} bytes"
    return Mutant(data, what, [(chunk.begin, chunk.end)])


@cache
def bomb(name):
    """Much of the same, compressed without saying how much it is: zeros in one form, messages in the other."""
    packer = zstandard.ZstdCompressor().compressobj() if name == "zstd" else lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin()] if name == "lz4" else []
    filling = bytes(12_400) if name == "zstd" else struct.pack("<BQHIQQ12369x", MESSAGE, 12_391, 1, 0, 0, 0)
    parts += [packer.compress(filling * 1000) for _ in range(BOMB_BYTES // 12_400_000)]
    return b"".join([*parts, packer.flush()])


def mutated_message(data, rng):
    """A message damaged in one place or several, cut short, or made longer."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, max(1, len(changed))))
        kind = rng.integers(5)
        if kind == 0 and changed:
            changed[at] ^= 1 << rng.integers(8)
        elif kind == 1:
            del changed[at:]
        elif kind == 2:
            size = int(rng.choice([1, 4, 8]))
            at -= at % 4
            changed[at : at + size] = (LIES[rng.integers(len(LIES))] % (1 << 8 * size)).to_bytes(size, "little")
        elif kind == 3:
            number = float(rng.choice([np.nan, np.inf, -np.inf, 1e38, -0.0]))
            at -= at % 4
            changed[at : at + 4] = struct.pack("<f", number)
        else:
            changed[at:at] = rng.bytes(rng.integers(1, 20))
    return bytes(changed)


def records_of(data, lidar):
    """The records of a file; ``lidar`` is the channel of its scans."""
    offset = len(MAGIC)
    while offset < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        begin, offset = offset, offset + 9 + length
        record = Record(opcode, begin, offset, defines=opcode in (SCHEMA, CHANNEL))
        inside = _unpacked(data[begin + 9 : offset]) if opcode == CHUNK else data[begin:offset]
        for inner, body in _walk(inside) if opcode in (CHUNK, MESSAGE) else ():
            if inner == MESSAGE and struct.unpack_from("<H", body)[0] == lidar:
                record.times_ns.add(struct.unpack_from("<Q", body, 6)[0])
            record.defines |= inner in (SCHEMA, CHANNEL)
        yield record


def _walk(data):
    offset = 0
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield opcode, data[offset + 9 : offset + 9 + length]
        offset += 9 + length


def _unpacked(body):
    (size,) = struct.unpack_from("<I", body, 28)
    name, stored = body[32 : 32 + size], body[40 + size :]
    if name == b"zstd":
        return zstandard.decompress(stored, max_output_size=1 << 26)
    return lz4.frame.decompress(stored) if name == b"lz4" else stored
