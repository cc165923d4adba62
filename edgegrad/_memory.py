"""How much memory a render needs, and whether there is so much: asked before it allocates.

A system that overcommits grants any request and kills the process once the pages are used, so waiting for an allocation to
fail is not enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch

from ._kernel import core

clear_geometry = core.clear_geometry

# Below, a render goes ahead: asking the system takes a fifth of a millisecond, as long as a small image.
LOOK_FROM = 256 << 20

# Of Embree's structure, a face, beyond the copies of faces and vertices: resident memory grew by 74.4 bytes a face between
# spheres of 327,680 and 1,310,720 faces, of which 12 are the faces, 18 the vertices and 1 says which were seen.
RAY_STRUCTURE_BYTES = 44
# csrc/scatter.h: samples are worked on in chunks, and only so many chunks a thread are in memory at a time. A chunk keeps
# rows apart by their owners, with room for some rows each as soon as there is one; runs of indices have the same owner.
CHUNK, CHUNKS_IN_FLIGHT, MOST_OWNERS, FEWEST_ROWS, RUN = 512, 16, 16, 16, 32
OWNER_BYTES, RECENT_BYTES = 56, 4096  # of an owner's empty buffer; of what a buffer knows of its last rows


# -- needs ------------------------------------------------------------------------------------------------------------


def ray_structure(faces: int, verts: int) -> int:
    """Bytes of Embree's structure and the copies that it is made from."""
    return faces * (RAY_STRUCTURE_BYTES + 12) + 36 * verts


def topology(faces: int) -> int:
    """Bytes of the edges of a closed mesh."""
    return 36 * faces + 9 * edges(faces)


def edges(faces: int) -> int:
    """Of a closed mesh."""
    return 3 * faces // 2


def view(height: int, width: int, verts: int, moves: bool) -> int:
    """Bytes for where vertices are in the image and where the loss looks."""
    return 8 * height * width + 41 * verts + 24 * verts * moves


def surface_measure(faces: int, verts: int, pixels: int, textured: bool, radiance: int, moves: bool) -> int:
    """Bytes for the faces laid end to end, which of them hang together, the pixels that large textured ones are left to, and what
    the controls need.

    radiance  bytes of the channels of one number of the image
    """
    return 9 * faces + (17 + radiance + 16 * moves) * verts + (faces + 8 * pixels) * textured


def edge_measure(faces: int) -> int:
    """Bytes for which side of a face is seen."""
    return faces


def creases(verts: int, pixels: int) -> int:
    """Bytes of the control of creases: its places at vertices, and where parts of the surface meet."""
    return 16 * verts + 5 * pixels


def curves_on_lines(curves: int) -> int:
    """Bytes, at most, of `curves` curves in view laid end to end and sorted by the lines that they lie on (csrc/coincident.h).

    A curve has 16 bytes in a list that doubles as it grows and 24 beside it; 64 in another such list, and again where others lie
    on its line, with up to 16 of two tables, 16 in each of up to 7 cells of the image, and 16 more, twice, once it has a
    companion; most pass one or two, and are alone.
    """
    return (2 * 16 + 24 + 64 + 2 * 16 + 7 * 16 + 2 * 16) * curves


def rows(samples: int, primitives: int | None, each: int, width: int, destinations: int) -> int:
    """Bytes of what `samples` samples leave to be added up: an index and `width` doubles a row.

    Runs of samples on one of `primitives` leave `each` rows together; None: every sample leaves its own.
    """
    threads = torch.get_num_threads()
    chunks = min(-(-samples // CHUNK), CHUNKS_IN_FLIGHT * threads)
    runs = samples = min(samples, CHUNK * chunks)
    if primitives is not None:  # they come in order, so there are no more runs than primitives and ends of chunks
        runs = min(samples, primitives + chunks)
    owners = min(threads, MOST_OWNERS)
    least = chunks * min(owners, -(-destinations // RUN)) * FEWEST_ROWS
    return max(each * runs, least) * (8 + 8 * width) + chunks * (owners * OWNER_BYTES + RECENT_BYTES)


# -- what there is ----------------------------------------------------------------------------------------------------


def available() -> int:
    """Bytes that this process can still have: of the machine, and of the control groups (containers) that it is in."""
    import psutil  # here, since few processes ever ask

    return min([psutil.virtual_memory().available, *_left_in_groups()])


def _left_in_groups(proc: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """Bytes that each control group, from this process's to the root, leaves; nothing where there are none."""
    try:
        lines = proc.read_text().splitlines()
    except OSError:
        return
    for line in lines:  # number:controllers:path, in version 2 without controllers
        _, controllers, path = line.split(":", 2)
        if not controllers:
            root, names = mount, ("memory.max", "memory.current", "inactive_file", "active_file")
        elif "memory" in controllers.split(","):
            root = mount / "memory"
            names = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file", "total_active_file"
        else:
            continue
        group = root / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(root) and (left := _left_in(folder, *names)) is not None:
                yield left


def _left_in(group: Path, limit: str, used: str, *reclaimable: str) -> int | None:
    """Bytes; None where there is no limit. Copies of files count as used, but the system gives them up when asked to."""
    try:
        most = (group / limit).read_text().strip()
        if most == "max":
            return None
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        files = sum(int(counts.get(name, 0)) for name in reclaimable)
        return max(0, int(most) - max(0, int((group / used).read_text()) - files))
    except (OSError, ValueError):
        return None


# -- the check --------------------------------------------------------------------------------------------------------


@contextmanager
def room(what: str, needs: Mapping[str, int], kept: Mapping[str, int], lower: Callable[[], str]) -> Iterator[None]:
    """Raises MemoryError, with figures and what to `lower`, before the block if there is less than it needs, and when an
    allocation in it fails all the same.

    needs  bytes by part
    kept   the same of what may be there already, from an earlier call
    """
    needed = sum(needs.values()) + sum(kept.values())

    def error(limit: str) -> MemoryError:
        largest = sorted({**needs, **kept}.items(), key=lambda part: -part[1])[:3]
        listed = ", ".join(f"{name} {size(count)}" for name, count in largest if count)
        return MemoryError(f"{what}: expected to need {limit}, got about {size(needed)} ({listed}); lower {lower()}")

    if needed >= LOOK_FROM and needed > available():
        clear_geometry()  # what other calls left behind; then nothing of this one's is there either
        if needed > (there := available()):
            raise error(f"at most the {size(there)} of memory that are free")
    try:
        yield
    except MemoryError as cause:  # the kernel's
        raise error("no more memory than the system grants") from cause
    except RuntimeError as cause:  # torch has no class of its own for it
        if "DefaultCPUAllocator" not in str(cause):
            raise
        raise error("no more memory than the system grants") from cause


def size(count: int) -> str:
    """Of bytes, with two or three digits, in powers of 1000; "" for none."""
    if count == 0:
        return ""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.{0 if count >= 10 * scale else 1}f} {unit}"
    return f"{count} B"
