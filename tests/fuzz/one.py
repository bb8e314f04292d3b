"""Fuzzes one reader; options are those of libFuzzer.

python tests/fuzz/one.py bag -max_total_time=60      with new inputs
python tests/fuzz/one.py bag found/crash-...         with this one
"""

import random
import resource
import shutil
import sys
import tempfile
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parent))

MEMORY, ADDRESSES, SECONDS = 1 << 30, 4 << 30, 10  # of one input: bytes, bytes, s
_MAX_INPUT = 1 << 15  # bytes

with atheris.instrument_imports(
    include=["stillmap", "rosbags", "laspy", "tomllib", "numpy.lib.format", "yaml", "pye57"]
):
    from targets import TARGETS, Target


def main(words: list[str]) -> None:
    """Run libFuzzer, which never returns."""
    name, *options = words
    target = TARGETS[name]
    # a wild count becomes an error instead of exhausting the machine
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    work = Path(tempfile.mkdtemp(prefix="stillmap-fuzz-"))
    corpus = work / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(target.seeds(_new(work / "seeds"))):
        (corpus / f"{number}").write_bytes(seed)
    given = [word for word in options if not word.startswith("-")]
    more = [] if given else [str(corpus)]
    limits = [f"-rss_limit_mb={MEMORY >> 20}", f"-timeout={SECONDS}", f"-max_len={_MAX_INPUT}"]
    place = work / "input"

    def run(data: bytes) -> None:
        target.run(data, _new(place))

    atheris.Setup(
        [sys.argv[0], *limits, *options, *more],
        run,
        **({"custom_mutator": _mutator(target)} if target.mutate is not None else {}),
    )
    atheris.Fuzz()


def _mutator(target: Target):  # type: ignore[no-untyped-def]
    def mutated(data: bytes, largest: int, seed: int) -> bytes:
        chance = random.Random(seed)

        def mutate(some: bytes) -> bytes:
            return bytes(atheris.Mutate(some, max(2 * len(some), 64)))

        if chance.random() < 0.2:
            return bytes(atheris.Mutate(data, largest))
        assert target.mutate is not None
        return target.mutate(data, mutate, chance)[:largest]

    return mutated


def _new(folder: Path) -> Path:
    """Empty the folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


if __name__ == "__main__":
    main(sys.argv[1:])
