"""Options of fits in tests: the same numbers each time, and no bars."""

from typing import Any

from edgegrad.fit import Checkpoint, FitOptions


def quiet(**options: Any) -> FitOptions:
    return FitOptions(**{"seed": 0, "progress": False, **options})


def arranged(**given: Any) -> dict[str, Any]:
    """Return arguments of a fit, those that are options, or of a checkpoint, in one object."""
    kept = {name: given.pop(name) for name in ("every", "resume") if name in given}
    if kept:
        given["checkpoint"] = Checkpoint(given["checkpoint"], **kept)
    names = FitOptions.__dataclass_fields__
    others = {name: value for name, value in given.items() if name not in names}
    return {**others, "options": quiet(**{name: given[name] for name in given if name in names})}
