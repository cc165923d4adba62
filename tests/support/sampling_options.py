"""Options of render() with some fields of their Sampling set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import edgegrad as eg


def with_sampling(options: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    """Return options of render() whose Sampling has other fields, unless the options set these."""
    given = options.get("sampling", eg.Sampling())
    default = eg.Sampling()
    kept = {name: value for name, value in changes.items() if getattr(given, name) == getattr(default, name)}
    return {**options, "sampling": replace(given, **kept)}
