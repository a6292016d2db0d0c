"""The mark of a conversion that is under way: what it converts, so that the same command can go on there."""

import json
from pathlib import Path
from typing import Any

from datagen.atomic_write import TEMPORARY_PREFIX, write_json
from datagen.errors import InputError
from datagen.formats.json_file import read_json_object

JOB_FILE = ".conversion.json"


def is_unfinished(folder: Path) -> bool:
    """Tell whether a folder holds a conversion that was not finished."""
    return (folder / JOB_FILE).is_file()


def begin(folder: Path, job: dict[str, Any]) -> None:
    """Mark a new or empty folder as holding the conversion ``job``, or go on where it holds the same one.

    Raises InputError where the folder holds anything else.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file, not a folder; name a new or empty folder for the dataset")
    if is_unfinished(folder):
        begun = read_json_object(folder / JOB_FILE)
        different = next((key for key in job if begun.get(key) != job[key]), None)
        if different is not None:
            raise InputError(
                f"{folder}: holds an unfinished conversion whose {different} is {json.dumps(begun.get(different))}, "
                f"now asked for is {json.dumps(job[different])}; finish that one, name another folder, or delete this "
                "one"
            )
        return
    there = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    foreign = [name for name in there if not name.startswith(TEMPORARY_PREFIX)]
    if foreign:
        raise InputError(f"{folder}: holds files already ({', '.join(foreign[:3])}); name a new or empty folder")
    write_json(folder / JOB_FILE, job)


def finish(folder: Path) -> None:
    """Take the mark away, and what killed runs left behind."""
    for leftover in folder.rglob(f"{TEMPORARY_PREFIX}*"):
        leftover.unlink(missing_ok=True)
    (folder / JOB_FILE).unlink(missing_ok=True)
