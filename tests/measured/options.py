"""What the commands that measure scenes take on their command line."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOWNLOADS = ROOT / "results-output"


@dataclass(frozen=True)
class Options:
    """The scenes to measure, where the real data lies, where pages go, and whether it is a try."""

    names: tuple[str, ...]
    data: Path
    to: Path
    quick: bool

    @classmethod
    def read(cls, arguments: Sequence[str], description: str, known: Sequence[str]) -> "Options":
        """Read ``[--quick] [--to FOLDER] [name ...]``; exits where they cannot be meant."""
        parser = argparse.ArgumentParser(description=description)
        parser.add_argument("--quick", action="store_true", help="coarse settings, to try it")
        parser.add_argument("--to", type=Path, help="docs; with --quick results-output/docs")
        parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(known)}")
        given = parser.parse_args(arguments)
        unknown = sorted(set(given.names) - set(known))
        if unknown:
            parser.error(f"no scene {', '.join(unknown)}; there are {', '.join(known)}")
        data = Path(os.environ.get("PRTBAKE_DATA", "")).resolve()
        if not (data / "meshes").is_dir():
            parser.error("PRTBAKE_DATA must name the folder of the real data")
        to = given.to or (DOWNLOADS / "docs" if given.quick else ROOT / "docs")
        return cls(tuple(given.names or known), data, to, given.quick)
