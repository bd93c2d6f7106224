"""`python -m scanfind` is `scanfind`."""

import sys

from scanfind.cli import main

sys.exit(main())
