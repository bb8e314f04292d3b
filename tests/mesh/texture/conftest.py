import sys
from pathlib import Path

# for made_up_rooms.py, beside the tests
sys.path.insert(0, str(Path(__file__).parent))
