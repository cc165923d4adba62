"""How much memory a render needs, and whether there is so much: asked before it allocates.

A system that overcommits grants any request and kills the process once the pages are used, so waiting for an allocation to
fail is not enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from ..library import core

clear_geometry = core.clear_geometry

# Below, a render goes ahead: asking the system takes a fifth of a millisecond, as long as a small image.
CHECKED_FROM = 256 << 20

# -- what there is ----------------------------------------------------------------------------------------------------


def available() -> int:
    """Return the bytes that this process can still have: of the machine, and of the control groups (containers) that it is in."""
    import psutil  # here, since few processes ever ask

    return min([psutil.virtual_memory().available, *_left_in_groups()])


def _left_in_groups(proc: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """Return the bytes that each control group, from this process's to the root, leaves; nothing where there are none."""
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
def room(what: str, needs: Mapping[str, int], lower: Callable[[], str]) -> Iterator[None]:
    """Raises MemoryError, with figures and what to `lower`, before the block if there is less than it `needs`, in bytes by
    part, and when an allocation in it fails all the same. Some may be there already, from an earlier call."""
    needed = sum(needs.values())

    def error(limit: str) -> MemoryError:
        largest = sorted(needs.items(), key=lambda part: -part[1])[:3]
        listed = ", ".join(f"{name} {size(count)}" for name, count in largest if count)
        return MemoryError(f"{what}: expected to need {limit}, got about {size(needed)} ({listed}); lower {lower()}")

    if needed >= CHECKED_FROM and needed > available():
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
    """Return a number of bytes as text, with two or three digits, in powers of 1000; "" for none."""
    if count == 0:
        return ""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.{0 if count >= 10 * scale else 1}f} {unit}"
    return f"{count} B"
