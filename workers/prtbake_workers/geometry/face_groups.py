"""Groups of faces, as files name them: one material each, where a request says so."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import I32, I64, Int32, Int64

MOST_GROUPS = 256
LONGEST_NAME = 100
"""Characters that are kept of a group's name: it stands in messages, requests and reports."""

UNNAMED = "unnamed"
OTHERS = "others"
"""Name of the group that holds what comes after the first `MOST_GROUPS` - 1."""


class SettledGroups(NamedTuple):
    """What `settle_groups` made of a file's groups.

    ``names`` are distinct and printable, of 1 to `LONGEST_NAME` characters; ``of_face`` is the
    number of each face's group; ``warnings`` say what was changed.
    """

    names: tuple[str, ...]
    of_face: Int32[I32, " tris"]
    warnings: list[str]


def settle_groups(names: Sequence[str], of_face: Int64[I64, " tris"]) -> SettledGroups:
    """Count and name the groups that have a face, in the order of the file.

    Parameters
    ----------
    names
        As the file has them: of any length, with any character, equal or empty.
    of_face
        Group of each face, an index of ``names``.
    """
    used, dense = np.unique(of_face, return_inverse=True)
    warnings: list[str] = []
    given = [names[index] for index in used[:MOST_GROUPS]]
    if len(used) > MOST_GROUPS:
        given[-1] = OTHERS
        warnings.append(
            f"the faces are in {len(used)} groups; those after the first {MOST_GROUPS - 1} are one"
        )
    legal = [printable(name) or UNNAMED for name in given]
    distinct = distinct_names(legal)
    cut = sum(len(name) > LONGEST_NAME for name in given)
    if cut:
        warnings.append(
            f"{cut} groups of faces have a name of more than {LONGEST_NAME} characters: cut"
        )
    renamed = [f"'{new}'" for old, new in zip(legal, distinct, strict=True) if old != new]
    if renamed:
        more = f" and {len(renamed) - 4} more" if len(renamed) > 4 else ""
        warnings.append(
            f"groups of faces share a name: {', '.join(renamed[:4])}{more} were numbered"
        )
    numbers = np.minimum(dense.reshape(-1), MOST_GROUPS - 1).astype(np.int32)
    return SettledGroups(tuple(distinct), numbers, warnings)


def printable(name: str) -> str:
    """Keep the first printable characters of a name, white space as single blanks."""
    # no longer than what could still be kept: a hostile name may be as long as its file
    words = name[: 16 * LONGEST_NAME].split()
    kept = "".join(char for char in " ".join(words) if char.isprintable())
    return kept[:LONGEST_NAME].strip()


def distinct_names(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Append a number to names that came before, or that are ``taken``."""
    # what stands in the file as it is stays as it is
    reserved, seen = {*names, *taken}, set(taken)
    distinct = []
    for name in names:
        number, found = 1, name
        while found in seen or (number > 1 and found in reserved):
            number += 1
            ending = f" ({number})"
            found = name[: LONGEST_NAME - len(ending)] + ending
        seen.add(found)
        distinct.append(found)
    return distinct
