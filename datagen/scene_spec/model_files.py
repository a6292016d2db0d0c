"""The files that a scene file names: where they lie, and what identifies their content."""

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from datagen.errors import InputError

PIECE = 1 << 20


def locate_models(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scene file's ``content`` with its models' paths made absolute from ``folder``, their SHA-256 set.

    Raises InputError where a file is missing, or is not the one that a given ``sha256`` identifies.
    """
    located = dict(content)
    if isinstance(content.get("blend"), dict):
        located["blend"] = _located(content["blend"], folder, "blend")
    if isinstance(content.get("objects"), list):
        located["objects"] = [
            _located_object(entry, folder, f"objects[{i}]") for i, entry in enumerate(content["objects"])
        ]
    return located


def portable(recipe: Any) -> Any:
    """Return a scene, dumped for JSON, with its models named by file name and SHA-256, wherever they lie."""
    if isinstance(recipe, list):
        return [portable(entry) for entry in recipe]
    if not isinstance(recipe, dict):
        return recipe
    result = {key: portable(value) for key, value in recipe.items()}
    if result.get("sha256") is not None:
        result["file"] = Path(result["file"]).name
    return result


def content_sha256(path: Path) -> str:
    """Return the SHA-256 (hexadecimal) of a model file and of the materials, buffers and pictures that it names.

    Raises InputError where the file itself cannot be read; what else is missing counts as missing.
    """
    digest = hashlib.sha256()
    try:
        _feed(digest, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a model file") from error
    for companion in sorted(set(_companions(path))):
        if companion.is_file():
            digest.update(companion.name.encode())
            _feed(digest, companion)
    return digest.hexdigest()


def _located_object(entry: Any, folder: Path, place: str) -> Any:
    if not isinstance(entry, dict):
        return entry
    located = _located(entry, folder, place)
    if isinstance(entry.get("parts"), list):
        parts = enumerate(entry["parts"])
        located["parts"] = [
            _located(part, folder, f"{place}.parts[{i}]") if isinstance(part, dict) else part for i, part in parts
        ]
    return located


def _located(entry: dict[str, Any], folder: Path, place: str) -> dict[str, Any]:
    if not isinstance(entry.get("file"), str):
        return dict(entry)
    path = (folder / Path(entry["file"]).expanduser()).resolve()
    found = content_sha256(path)
    expected = entry.get("sha256")
    if expected is not None and expected != found:
        raise InputError(
            f"{path}: its SHA-256 is {found}, but {place}.sha256 says {expected}; restore the file, or drop the sha256"
        )
    return entry | {"file": str(path), "sha256": found}


def _feed(digest: Any, path: Path) -> None:
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            digest.update(piece)


def _companions(path: Path) -> Iterator[Path]:
    if path.suffix.lower() == ".obj":
        for name in _named_in(path, rb"^mtllib[ \t]+(.+?)[ \t\r]*$"):
            materials = path.parent / name
            yield materials
            if materials.is_file():
                # The picture's name stands last, behind options.
                names = _named_in(materials, rb"^[ \t]*(?:map_\w+|bump|disp|norm)[ \t]+(?:.*[ \t])?(\S+)[ \t\r]*$")
                yield from (materials.parent / picture.replace("\\", "/") for picture in names)
    elif path.suffix.lower() == ".gltf":
        try:
            content = json.loads(path.read_bytes())
        except ValueError:
            return  # Blender will say what is wrong with it
        entries = [entry for key in ("buffers", "images") for entry in content.get(key, ())]
        uris = [entry["uri"] for entry in entries if isinstance(entry.get("uri"), str)]
        yield from (path.parent / unquote(uri) for uri in uris if not uri.startswith("data:"))


def _named_in(path: Path, pattern: bytes) -> list[str]:
    names = re.findall(pattern, path.read_bytes(), flags=re.MULTILINE | re.IGNORECASE)
    return [name.decode("utf-8", errors="replace").strip() for name in names]
