"""Files in folders that others are writing to."""

import os
from pathlib import Path


def files_in(folder: Path) -> list[Path]:
    """List all files below a folder; those below one that goes while it is looked at are left out."""
    return [Path(where) / name for where, _, names in os.walk(folder) for name in names]
