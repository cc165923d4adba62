"""Run the command line: python -m edgegrad."""

import sys

from .cli import main

sys.exit(main())
