"""What the commands of both reports share: errors in one line, and exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from edgegrad.optional import require

from .document import Document

INTERRUPTED = 130  # exit code of a program that Ctrl-C ended, as shells have it


def run(
    parser: argparse.ArgumentParser,
    measure: Callable[..., tuple[Document, bool]],
    end: Callable[[Document], int],
    argv: Sequence[str] | None,
) -> int:
    """Measures what was asked for. The exit code is that of `end`, 2 after an error, 130 after Ctrl-C."""
    options: dict[str, Any] = vars(parser.parse_args(argv))
    try:
        require("matplotlib", "edgegrad[figures]", parser.prog)  # before the measurements rather than after them
        options["out"].mkdir(parents=True, exist_ok=True)
        document, interrupted = measure(**options)
    except (OSError, ValueError, ImportError) as error:
        print(f"{parser.prog}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    code = end(document)
    if not interrupted:
        return code
    print(f"{parser.prog}: interrupted; what is measured is kept in {options['out']}", file=sys.stderr)
    return INTERRUPTED
