"""Peak memory of code that runs in a process of its own."""

import subprocess
import sys

READ = """
import sys
import stillmap
try:
    stillmap.read(sys.argv[1])
except stillmap.InputError as error:
    print(error)
"""
# the peak of `getrusage` begins with the memory of the process that started this one
_REPORT = """
from pathlib import Path
print(int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) >> 10)
"""


def run_measured(code: str, *words: object) -> tuple[list[str], int]:
    """Run code with arguments; the lines that it prints, and the peak in MB."""
    run = subprocess.run(
        [sys.executable, "-c", code + _REPORT, *map(str, words)],
        capture_output=True,
        text=True,
        check=True,
    )
    *said, megabytes = run.stdout.splitlines()
    return said, int(megabytes)
