"""Runs `stillmap` with views selected by their resolution alone, for comparison.

python benchmarks/resolution_alone.py map INPUT -o DIR ...
"""

import functools
import sys

from stillmap.cli.main import main
from stillmap.mesh import build
from stillmap.mesh.place import assign_views

if __name__ == "__main__":
    build.assign_views = functools.partial(assign_views, use_occlusion=False)
    sys.exit(main(sys.argv[1:]))
