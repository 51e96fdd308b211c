"""An object in a file, arrays bit by bit: values and classes of a list given, nothing that could be executed."""

from __future__ import annotations

import dataclasses
import zlib
from collections import OrderedDict, deque
from collections.abc import Callable, Container, Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from scipy.spatial import KDTree

from scanchain.errors import InputError
from scanchain.plugins import is_class_name

_MAGIC = b"scanchain snapshot 1\n"
_PLAIN = {"list": list, "tuple": tuple, "set": set}
_END = 16  # bytes: length of the tree, CRC-32 of all before


class Classes:
    """The classes that may stand in a snapshot, by name, and the attributes in them that are left out.

    rebuilt : functions that rebuild these attributes of an object from its others when it is read
    version : a line that identifies the code of the classes; that of another is not read
    """

    def __init__(
        self, kinds: Iterable[type], rebuilt: Mapping[tuple[type, str], Callable[[Any], Any]], version: str
    ) -> None:
        self.by_name = {kind.__name__: kind for kind in kinds}
        self.rebuilt = rebuilt
        self.version = version

    def of(self, name: str) -> type:
        """The class of that name. Raises InputError for one that is not listed."""
        if name not in self.by_name:
            raise InputError(f"a snapshot names the class {name!r}, which does not belong there; it is not read")
        return self.by_name[name]


def write_snapshot(path: Path, value: Any, classes: Classes) -> None:
    """Write a value whole or not at all: a snapshot that was there before stays until the new one is on disk.

    Raises TypeError for a class that is not listed, OSError where the disk is full.
    """
    new = path.with_name(f"{path.name}.new")
    try:
        with new.open("wb") as file:
            packer = _Packer(file, classes)
            tree = msgspec.msgpack.encode(packer.pack(value))
            packer.write(tree)
            file.write(len(tree).to_bytes(8, "little") + packer.crc.to_bytes(8, "little"))
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def read_snapshot(path: Path, classes: Classes, named: Container[str] = ()) -> Any:
    """The value again. Raises InputError for a file that is not whole, no snapshot or of other code.

    named : MODULE:CLASS of the reading user, who alone names code; a text of this form that is another is refused
    """
    data = path.read_bytes()
    body, end = data[:-_END], data[-_END:]
    size = int.from_bytes(end[:8], "little")
    if not data.startswith(_MAGIC) or zlib.crc32(body) != int.from_bytes(end[8:], "little") or size > len(body):
        raise InputError(f"{path}: is no whole snapshot; run again without --resume")
    version = body[len(_MAGIC) :].split(b"\n", 1)[0].decode()
    if version != classes.version:
        raise InputError(f"{path}: was made by {version}, this is {classes.version}; run again without --resume")
    return _Unpacker(body, classes, named).unpack(msgspec.msgpack.decode(body[len(body) - size :]))


class _Packer:
    """Makes a tree of plain values; arrays go into the file ahead of it. What is met twice is one thing."""

    def __init__(self, file: BinaryIO, classes: Classes) -> None:
        self.file, self.classes = file, classes
        self.seen: dict[int, int] = {}
        self.made: list[np.ndarray] = []  # kept, so that nothing else comes to lie where they did
        self.offset, self.crc = 0, 0
        self.write(_MAGIC + classes.version.encode() + b"\n")

    def write(self, data: Any) -> None:
        self.file.write(data)
        self.crc = zlib.crc32(data, self.crc)
        self.offset += memoryview(data).nbytes

    def pack(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, float, str, bytes):
            return value
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, value.tobytes()]
        if isinstance(value, Enum):
            return ["enum", type(value).__name__, value.value]
        if id(value) in self.seen:
            return ["again", self.seen[id(value)]]
        number = self.seen[id(value)] = len(self.seen)
        return self._container(value, number)

    def _container(self, value: Any, number: int) -> list[Any]:
        kind = type(value)
        if isinstance(value, np.ndarray):
            return ["array", number, *self._array(value)]
        if isinstance(value, KDTree):
            self.made.append(np.array(value.data))
            return ["tree", number, self.pack(self.made[-1])]
        if kind in (list, tuple, set):
            return [kind.__name__, number, [self.pack(item) for item in value]]
        if kind is deque:
            return ["deque", number, [self.pack(item) for item in value], value.maxlen]
        if kind in (dict, OrderedDict):
            return [kind.__name__, number, [[self.pack(k), self.pack(v)] for k, v in value.items()]]
        if self.classes.by_name.get(kind.__name__) is not kind:
            raise TypeError(f"{kind.__module__}.{kind.__name__} is not listed for snapshots")
        fields = [
            [name, self.pack(getattr(value, name))]
            for name in _field_names(value)
            if (kind, name) not in self.classes.rebuilt
        ]
        return ["object", number, kind.__name__, fields]

    def _array(self, value: np.ndarray) -> list[Any]:
        is_fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        flat = value.ravel(order="F" if is_fortran else "C")
        offset = self.offset
        self.write(flat.view(np.uint8).data if flat.size else b"")
        return [value.dtype.str, value.shape, is_fortran, value.flags.writeable, offset, flat.nbytes]


class _Unpacker:
    """Builds the value again, objects without calling anything of theirs."""

    def __init__(self, body: bytes, classes: Classes, named: Container[str]) -> None:
        self.body, self.classes, self.named = body, classes, named
        self.seen: dict[int, Any] = {}

    def unpack(self, node: Any) -> Any:
        if isinstance(node, str) and is_class_name(node) and node not in self.named:
            raise InputError(f"a snapshot names the code {node!r}, the configuration does not; it is not read")
        if not isinstance(node, list):
            return node
        match node:
            case ["scalar", dtype, data]:
                return np.frombuffer(data, dtype)[0]
            case ["enum", name, value]:
                return self.classes.of(name)(value)
            case ["again", number]:
                return self.seen[number]
            case ["object", number, name, fields]:
                return self._object(number, self.classes.of(name), fields)
            case [_, number, *_]:
                self.seen[number] = result = self._container(node)
                return result
        raise InputError("a snapshot holds something unknown; run again without --resume")

    def _container(self, node: list[Any]) -> Any:
        match node:
            case ["array", _, dtype, shape, is_fortran, is_writeable, offset, size]:
                data = np.frombuffer(self.body[offset : offset + size], dtype)
                array = data.reshape(shape, order="F" if is_fortran else "C").copy(order="K")
                array.flags.writeable = is_writeable
                return array
            case ["tree", _, points]:
                return KDTree(self.unpack(points))
            case ["list" | "tuple" | "set" as name, _, items]:
                return _PLAIN[name](self.unpack(item) for item in items)
            case ["deque", _, items, maxlen]:
                return deque((self.unpack(item) for item in items), maxlen)
            case ["dict" | "OrderedDict" as name, _, items]:
                pairs = [(self.unpack(key), self.unpack(value)) for key, value in items]
                return dict(pairs) if name == "dict" else OrderedDict(pairs)
        raise InputError("a snapshot holds something unknown; run again without --resume")

    def _object(self, number: int, kind: type, fields: list[Any]) -> Any:
        if issubclass(kind, tuple | msgspec.Struct):
            self.seen[number] = made = kind(**{name: self.unpack(value) for name, value in fields})
            return made
        self.seen[number] = made = object.__new__(kind)
        for name, value in fields:
            object.__setattr__(made, name, self.unpack(value))
        for (owner, name), make in self.classes.rebuilt.items():
            if owner is kind:
                object.__setattr__(made, name, make(made))
        return made


def _field_names(value: Any) -> Iterable[str]:
    if isinstance(value, tuple):
        return value._fields  # type: ignore[attr-defined]
    if isinstance(value, msgspec.Struct):
        return value.__struct_fields__
    if dataclasses.is_dataclass(value):
        return [field.name for field in dataclasses.fields(value)]
    return vars(value)
