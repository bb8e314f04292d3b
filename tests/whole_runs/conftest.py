"""Makes the modules beside the tests known to them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent))
