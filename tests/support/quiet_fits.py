"""Options of fits in tests: the same numbers each time, and no bars."""

from typing import Any

from edgegrad.fit import FitOptions


def quiet(**options: Any) -> FitOptions:
    return FitOptions(**{"seed": 0, "progress": False, **options})


def arranged(**given: Any) -> dict[str, Any]:
    """Return arguments of a fit, those that are options in one object."""
    names = FitOptions.__dataclass_fields__
    others = {name: value for name, value in given.items() if name not in names}
    return {**others, "options": quiet(**{name: given[name] for name in given if name in names})}
