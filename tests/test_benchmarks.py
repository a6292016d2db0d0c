"""Benchmarks run by hand, and rarely: what they import must still be there when they do."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

BENCHMARKS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("path", BENCHMARKS, ids=[path.stem for path in BENCHMARKS])
def test_a_benchmark_imports_names_that_there_are(path):
    missing = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            package = node.module.split(".")[0]
            # Blender is not loaded into this process for their sake.
            if package in ("datagen", "fusion") and not node.module.startswith("datagen.blender"):
                module = importlib.import_module(node.module)
                parts = {part.name for part in pkgutil.iter_modules(getattr(module, "__path__", []))}
                names = (alias.name for alias in node.names)
                missing += [f"{node.module}.{n}" for n in names if not hasattr(module, n) and n not in parts]
    assert missing == []
