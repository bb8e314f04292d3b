"""`python -m stillmap` is the `stillmap` command."""

import sys

from stillmap.cli import main

sys.exit(main())
