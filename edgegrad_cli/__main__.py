"""python -m edgegrad_cli."""

import sys

from . import main

sys.exit(main())
