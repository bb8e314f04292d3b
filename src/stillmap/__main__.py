"""`python -m stillmap` is the `stillmap` command."""

import sys

from stillmap.cli.main import main

sys.exit(main())
