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
        refuse_unknown(parser, given.names, known)
        data = real_data(parser)
        to = given.to or (DOWNLOADS / "docs" if given.quick else ROOT / "docs")
        return cls(tuple(given.names or known), data, to, given.quick)


@dataclass(frozen=True)
class Page:
    """The scenes to measure, the folder of a page whose table keeps the others' rows, the data."""

    names: tuple[str, ...]
    to: Path
    data: Path

    @classmethod
    def read(cls, arguments: Sequence[str], page: str, known: Sequence[str]) -> "Page":
        """Read ``[--scenes a,b] [--to FOLDER]``; exits where they cannot be meant."""
        parser = argparse.ArgumentParser(description=f"Measure docs/measured/{page}.md anew.")
        parser.add_argument("--scenes", help=f"of {','.join(known)}; the others keep their rows")
        parser.add_argument(
            "--to", type=Path, default=ROOT / "docs" / "measured",
            help=f"folder of {page}.csv and .md",
        )  # fmt: skip
        given = parser.parse_args(arguments)
        names = tuple(known if given.scenes is None else given.scenes.split(","))
        refuse_unknown(parser, names, known)
        return cls(names, given.to, real_data(parser))


def refuse_unknown(
    parser: argparse.ArgumentParser, names: Sequence[str], known: Sequence[str]
) -> None:
    """Exit where a scene is named that there is not."""
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no scene {', '.join(unknown)}; there are {', '.join(known)}")


def real_data(parser: argparse.ArgumentParser) -> Path:
    """Give the folder of the real data; exit where none is named."""
    data = Path(os.environ.get("PRTBAKE_DATA", "")).resolve()
    if not (data / "meshes").is_dir():
        parser.error("PRTBAKE_DATA must name the folder of the real data")
    return data
