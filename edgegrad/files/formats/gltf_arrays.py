"""The numbers of glTF files: buffers, accessors, and the attributes and triangles of primitives."""

from __future__ import annotations

import base64
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np

from ...optional import require
from .context import OR_WITHOUT_MATERIALS, Folder
from .gltf import DRACO, QUANTIZED, READ, File, entry
from .part import FormatError

MOST_ZEROS = 1 << 24  # rows that a glTF may ask for without holding them
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}  # a matrix column by column
STRIP, FAN, TRIANGLES = 5, 6, 4


class Arrays:
    """The accessors of a file. Methods raise FormatError or FileNotFoundError for an accessor that is not there in full."""

    def __init__(self, file: File, folder: Folder) -> None:
        self.tree, self.chunk, self.folder = file.tree, file.chunk, folder
        self.buffers: dict[int, bytes] = {}
        self.known: dict[int, np.ndarray] = {}
        empty = [accessor for accessor in self.tree.get("accessors", []) if "bufferView" not in accessor]
        zeros = sum(max(accessor["count"], 0) for accessor in empty)
        if zeros > MOST_ZEROS:
            raise FormatError(
                f"expected accessors with data, got some without that would fill {zeros} rows; export it plain"
            )

    def get(self, index: Any) -> np.ndarray:
        """Return an accessor's rows (count, K) in the type of the file, normalised or not. Without a view of a buffer these are
        zeros, beneath those that are given one by one."""
        accessor = entry(self.tree, "accessors", index)
        if index not in self.known:
            count, kind = accessor["count"], accessor["type"]
            if not isinstance(count, int) or count < 1 or kind not in COLUMNS:
                raise FormatError(
                    f"expected accessors of 1 to 4 numbers a row, or of 4 × 4, got {count!r} rows of {kind!r}; export it again"
                )
            component, columns = accessor["componentType"], COLUMNS[kind]
            if "bufferView" in accessor:
                rows = self._rows(accessor, component, count, columns)
            else:
                rows = np.zeros((count, columns), _dtype(component))
            if "sparse" in accessor:
                rows, sparse = rows.copy(), accessor["sparse"]
                where = self._rows(sparse["indices"], sparse["indices"]["componentType"], sparse["count"], 1)
                rows[where[:, 0]] = self._rows(sparse["values"], component, sparse["count"], columns)
            self.known[index] = rows
        return self.known[index]

    def view(self, index: Any) -> memoryview:
        """Return the bytes of a view of a buffer."""
        view = entry(self.tree, "bufferViews", index)
        buffer = self._buffer(view["buffer"], set(view.get("extensions", {})) - READ)
        start, size = view.get("byteOffset", 0), view["byteLength"]
        if not 0 <= start <= start + size <= len(buffer):
            raise FormatError(
                f"expected bytes {start} to {start + size} of buffer {view['buffer']} for bufferViews[{index}], "
                f"got {len(buffer)} bytes; the file is truncated or damaged"
            )
        return memoryview(buffer)[start : start + size]

    def _rows(self, given: dict[str, Any], component: int, count: int, columns: int) -> np.ndarray:
        dtype = _dtype(component)
        stride = entry(self.tree, "bufferViews", given["bufferView"]).get("byteStride", columns * dtype.itemsize)
        if stride < columns * dtype.itemsize:
            least = columns * dtype.itemsize
            raise FormatError(
                f"expected a byteStride of {least} or more for rows of {least} bytes, got {stride}; export it again"
            )
        strides, start, view = (stride, dtype.itemsize), given.get("byteOffset", 0), self.view(given["bufferView"])
        end = start + (count - 1) * stride + columns * dtype.itemsize
        if not 0 <= start <= end <= len(view):
            raise FormatError(
                f"expected {count} rows of {columns} × {dtype.name} from byte {start} to {end} of "
                f"bufferViews[{given['bufferView']}], got {len(view)} bytes; the file is truncated or damaged"
            )
        return np.ndarray((count, columns), dtype, view, start, strides)

    def _buffer(self, index: Any, extensions: set[str]) -> bytes:
        """Return a buffer for a view with these extensions."""
        buffer = entry(self.tree, "buffers", index)
        if index not in self.buffers:
            if "uri" in buffer:
                self.buffers[index] = content(buffer["uri"], self.folder, "")
            elif index == 0 and self.chunk is not None:
                self.buffers[index] = self.chunk
            else:
                held = sorted(extensions | set(buffer.get("extensions", {})) - READ)
                if not held:
                    raise FormatError(
                        f"expected the data of buffer {index} by a uri, got none; export it again, or as GLB"
                    )
                where = f"the extension {', '.join(held)}, which is not read"
                raise FormatError(
                    f"expected the data of buffer {index}, got it in {where}; export it without compression"
                )
        return self.buffers[index]


class Geometry:
    def __init__(self, arrays: Arrays, given: dict[str, Any]) -> None:
        self.arrays, self.given = arrays, given
        self.decoded = self._decoded()

    def attribute(self, name: str) -> np.ndarray | None:
        """Return numbers (N, K), normalised integers as −1 or 0 to 1; None without the attribute. Raises FormatError."""
        index = self.given["attributes"].get(name)
        return None if index is None else self._numbers(name, index)

    def integers(self, name: str) -> np.ndarray | None:
        """Return integers (N, K) int64; None without the attribute. Raises FormatError."""
        index = self.given["attributes"].get(name)
        if index is None:
            return None
        rows = self._get(index)
        if rows.dtype.kind != "u":
            raise FormatError(f"expected unsigned integers for {name}, got {rows.dtype}; export it again")
        return rows.astype(np.int64)

    def targets(self, name: str, shape: tuple[int, ...]) -> list[np.ndarray | None]:
        """Return an attribute's differences, of this shape, in each morph target; None where it has none. Raises
        FormatError."""
        found = []
        for number, target in enumerate(self.given.get("targets", [])):
            rows = None if name not in target else self._numbers(name, target[name])
            if rows is not None and rows.shape != shape:
                raise FormatError(
                    f"expected {name} of shape {shape} in morph target {number}, got {rows.shape}; export it again"
                )
            found.append(rows)
        return found

    def _numbers(self, name: str, index: Any) -> np.ndarray:
        rows, accessor = self._get(index), self.arrays.tree["accessors"][index]
        if rows.dtype.kind == "f":
            return rows
        tree = self.arrays.tree
        quantized = QUANTIZED in tree.get("extensionsUsed", ()) or QUANTIZED in tree.get("extensionsRequired", ())
        normalized = accessor.get("normalized", False) or name.startswith("COLOR_")  # which some writers do not say
        if not quantized and not (normalized and name.startswith(("TEXCOORD_", "COLOR_", "WEIGHTS_"))):
            raise FormatError(
                f"expected {name} as floats, got integers without the extension {QUANTIZED}; export it plain"
            )
        return normalised(rows) if normalized else rows.astype(np.float64)

    def triangles(self) -> np.ndarray:
        """Return the indices (F, 3) of vertices, from a list, strip or fan. Raises FormatError."""
        mode, index = self.given.get("mode", TRIANGLES), self.given.get("indices")
        if DRACO in self.given.get("extensions", {}):
            mode = TRIANGLES  # it holds no other
        if index is None:
            flat = np.arange(len(self._get(self.given["attributes"]["POSITION"])))
        else:
            given = self._get(index)
            if given.dtype.kind != "u":
                raise FormatError(f"expected unsigned integers for indices, got {given.dtype}; export it again")
            flat = given.reshape(-1).astype(np.int64)
        if mode == TRIANGLES:
            if len(flat) % 3:
                raise FormatError(
                    f"expected three indices a triangle, got {len(flat)} in all; it is truncated or damaged"
                )
            return flat.reshape(-1, 3)
        if len(flat) < 3:
            return np.zeros((0, 3), np.int64)
        if mode == FAN:
            hub, around = flat[:1], flat[1:]
            return np.stack([around[:-1], around[1:], np.repeat(hub, len(around) - 1)], 1)
        first = np.arange(len(flat) - 2)
        odd = first % 2
        strip = np.stack([flat[first], flat[first + 1 + odd], flat[first + 2 - odd]], 1)
        # Triangles with a corner twice only lead from one strip to the next.
        return strip[(strip[:, 0] != strip[:, 1]) & (strip[:, 1] != strip[:, 2]) & (strip[:, 2] != strip[:, 0])]

    def _get(self, index: Any) -> np.ndarray:
        if index in self.decoded:
            return self.decoded[index]
        accessor, tree = entry(self.arrays.tree, "accessors", index), self.arrays.tree
        held = ({*self.given.get("extensions", {})} | {*accessor.get("extensions", {})}) - READ
        if index == self.given["attributes"].get("POSITION"):  # all in one point, they would be no shape
            held |= {name for name in tree.get("extensionsUsed", ()) if name.endswith("compression")}
        if held and "bufferView" not in accessor and "sparse" not in accessor:
            listed = ", ".join(sorted(held))
            raise FormatError(
                f"expected accessors with data, got it in the extension {listed} alone; export it without"
            )
        return self.arrays.get(index)

    def _decoded(self) -> dict[int, np.ndarray]:
        """Return the arrays of a compressed primitive by accessor. Raises FormatError, or ImportError without the decoder."""
        given = self.given.get("extensions", {}).get(DRACO)
        if given is None:
            return {}
        require("DracoPy", "edgegrad[files]", f"reading glTF with {DRACO}")
        decode = require("trimesh.exchange.gltf.extensions", "trimesh", "reading meshes").draco_decode
        found: dict[int, np.ndarray] = {}
        views = {given["bufferView"]: bytes(self.arrays.view(given["bufferView"]))}
        decode({"data": given, "accessors": found, "views": views, "primitive": self.given})
        for name in given["attributes"]:
            index = self.given["attributes"][name]
            accessor = entry(self.arrays.tree, "accessors", index)
            announced, got = (accessor["count"], COLUMNS.get(accessor["type"])), np.shape(found.get(index, ()))
            if got != announced:
                raise FormatError(f"expected {name} of shape {announced} in {DRACO}, got {got}; export it again")
        if "indices" in self.given:
            if self.given["indices"] not in found:
                raise FormatError(f"expected triangles in {DRACO}, got points; export it again")
            found[self.given["indices"]] = np.reshape(found[self.given["indices"]], (-1, 1))
        return found


def normalised(rows: np.ndarray) -> np.ndarray:
    """Return integers as numbers from −1 or 0 to 1, float64."""
    return np.maximum(rows / np.float64(np.iinfo(rows.dtype).max), -1.0)


def content(uri: str, folder: Folder, advice: str = OR_WITHOUT_MATERIALS) -> bytes:
    """Return the bytes of a URI: in itself, or in a file of the folder. Raises FormatError or FileNotFoundError, with more
    advice."""
    if not uri.startswith("data:"):
        return folder.get(uri, advice)
    head, _, text = uri.partition(",")
    held = unquote_to_bytes(text)
    return base64.b64decode(held) if head.endswith(";base64") else held


def _dtype(component: Any) -> np.dtype:
    if component not in COMPONENTS:
        raise FormatError(f"expected a componentType of glTF 2.0, got {component!r}; export it again")
    return np.dtype(COMPONENTS[component])
