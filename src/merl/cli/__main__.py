"""Run the command line: python -m merl.cli."""

import sys

from merl.cli import main

sys.exit(main())
