"""Do README's tests notice a wrong sign, index, coefficient or time? Each entry of `mutations.toml` is one such change.

    python tests/mutate.py [--shard K/N] [--only WORD]

For each entry the package and its tests are copied to a temporary folder, the change is made there, and the entry's
tests run as README's command runs them, so without those marked `long`. The run names the changes that no test
noticed, the survivors, and fails if there are any but those that are shown to be equivalent. It takes about 20
minutes on one core; shards share it out.
"""

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMIT = 600  # seconds that the tests of one change may run; a change that takes more is noticed
KILLED, SURVIVED, EQUIVALENT = "killed", "SURVIVED", "equivalent"


@dataclasses.dataclass(frozen=True)
class Mutation:
    """One change of the package.

    Attributes:
        name: what it changes.
        file: the file, from the root of the repository.
        old: the text that it replaces, which stands in the file exactly once.
        new: the text that it puts there.
        tests: node ids of functions or files, without parameters, so that pytest selects what README's command does.
        equivalent: why no test can notice it; empty for the others.
    """

    name: str
    file: str
    old: str
    new: str
    tests: list[str]
    equivalent: str = ""

    def source(self, root: Path = ROOT) -> str:
        """The changed source of the file; ValueError if the old text does not stand there exactly once."""
        source = (root / self.file).read_text(encoding="utf-8")
        if source.count(self.old) != 1:
            count = source.count(self.old)
            raise ValueError(f"{self.name}: {self.old!r} must stand once in {self.file}, not {count} times")
        return source.replace(self.old, self.new)


def mutations() -> list[Mutation]:
    """All entries of `mutations.toml`."""
    listed = tomllib.loads((ROOT / "tests/mutations.toml").read_text(encoding="utf-8"))
    return [Mutation(**entry) for entry in listed["mutation"]]


def tried(mutation: Mutation | None, tests: list[str]) -> tuple[str, str]:
    """KILLED or SURVIVED, and what pytest printed, of the tests in a copy with a change, or, with no limit, without."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("lieint_jax", "tests"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        (ROOT / ".jax_cache").mkdir(exist_ok=True)
        (copy / ".jax_cache").symlink_to(ROOT / ".jax_cache")  # its keys are the programs, so a change is no danger
        if mutation is not None:
            (copy / mutation.file).write_text(mutation.source(copy), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-p", "no:cacheprovider", *tests]
        environment, limit = os.environ | {"PYTHONPATH": folder}, LIMIT if mutation else None
        try:
            run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return KILLED, f"no end after {LIMIT} s"
    if run.returncode and not _failed(run.stdout):
        raise SystemExit(f"pytest ended with {run.returncode} for {tests}:\n{run.stdout}{run.stderr}")
    return (KILLED if run.returncode else SURVIVED), run.stdout


def _failed(output: str) -> str:
    """The line of the first test that failed or could not be imported; empty if there is none."""
    return next((line for line in output.splitlines() if line.startswith(("FAILED", "ERROR "))), "")


def part(entries: list[Mutation], shard: str, word: str) -> list[Mutation]:
    """The K-th of N parts, "K/N", of the entries whose names contain a word."""
    k, n = map(int, shard.split("/"))
    if not 1 <= k <= n:
        raise SystemExit(f"--shard takes K/N with 1 ≤ K ≤ N, such as 2/4; got {shard}")
    return [entry for entry in entries if word in entry.name][k - 1 :: n]


def main() -> None:
    """Try the changes, print a line for each, and fail if one was not noticed that should have been."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--shard", default="1/1", metavar="K/N", help="the K-th of N parts of the list")
    parser.add_argument("--only", default="", metavar="WORD", help="the entries whose names contain this")
    options = parser.parse_args()
    entries = part(mutations(), options.shard, options.only)
    tests = sorted({test for entry in entries for test in entry.tests})
    verdict, output = tried(None, tests)
    if verdict == KILLED:
        raise SystemExit(f"the tests fail without any change:\n{output}")
    wrong = []
    for entry in entries:
        begin = time.monotonic()
        verdict, output = tried(entry, entry.tests)
        if entry.equivalent:
            verdict = EQUIVALENT if verdict == SURVIVED else f"{KILLED}, and listed as equivalent"
        if verdict not in (KILLED, EQUIVALENT):
            wrong.append(f"{entry.name} ({entry.file}): {verdict}")
        by = _failed(output).partition(" - ")[0]
        print(f"{verdict:<10} {entry.name} ({time.monotonic() - begin:.0f} s) {by}", flush=True)
    print(f"{len(entries)} changes, {len(wrong)} not as they should be", *wrong, sep="\n")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
