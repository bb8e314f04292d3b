"""Puts the ways that these tests make up where the tests can import them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
