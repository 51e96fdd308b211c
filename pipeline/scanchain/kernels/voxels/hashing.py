"""Open addressing on packed voxel coordinates: one int64 key a voxel, linear probing, a power of two of slots."""

import numpy as np

from scanchain.kernels.compiling import njit

EMPTY = np.int64(-1)
_OFFSET = 1 << 20
_LIMIT = (1 << 21) - 1
REACH = float(_OFFSET - 64)  # voxels around any point of the space, within which no two have one key


@njit(inline="always")
def pack(ix: int, iy: int, iz: int) -> int:
    """One non-negative int64 for a voxel; unique for coordinates in [−2²⁰, 2²⁰), larger ones collide."""
    return (((ix + _OFFSET) & _LIMIT) << 42) | (((iy + _OFFSET) & _LIMIT) << 21) | ((iz + _OFFSET) & _LIMIT)


@njit(inline="always")
def key_of(x: float, y: float, z: float, scale: float) -> int:
    """Key of the voxel that holds a point; scale : voxels a meter."""
    return pack(int(np.floor(x * scale)), int(np.floor(y * scale)), int(np.floor(z * scale)))


@njit(inline="always")
def unpack(key: int):
    """The voxel coordinates of a key, pack's inverse."""
    return (key >> 42) - _OFFSET, ((key >> 21) & _LIMIT) - _OFFSET, (key & _LIMIT) - _OFFSET


@njit(inline="always")
def find(keys, key: int):
    """Slot that holds the key, or ~slot (negative) of the empty slot where it belongs."""
    slot = first_slot(keys.size, key)
    while True:
        held = keys[slot]
        if held == key:
            return slot
        if held == EMPTY:
            return ~slot
        slot = (slot + 1) & (keys.size - 1)


@njit(inline="always")
def find_row(rows, keys, key: int) -> int:
    """Row of ``keys`` (V,) that holds the key, or ~slot (negative) of the empty slot where that row belongs.

    rows : (S,) int32, −1 where a slot is empty; much smaller than slots that hold keys, for fast probing
    """
    slot = first_slot(rows.size, key)
    while True:
        row = int(rows[slot])
        if row < 0:
            return ~slot
        if keys[row] == key:
            return row
        slot = (slot + 1) & (rows.size - 1)


@njit(inline="always")
def first_slot(slots: int, key: int) -> int:
    """The multiplicative hash of Knuth (1973, . 6.4) with 2⁶⁴/φ; the high bits are folded onto the low ones."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return int(np.int64((mixed >> np.uint64(32)) & np.uint64(slots - 1)))
