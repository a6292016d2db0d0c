"""Benchmarks run by hand, and rarely: what they import must still be there when they do."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
BENCHMARKS = sorted((CHECKOUT / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("path", BENCHMARKS, ids=[path.stem for path in BENCHMARKS])
def test_a_benchmark_imports_names_that_there_are(path):
    missing = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            package = node.module.split(".")[0]
            # Blender is not loaded into this process for their sake.
            if package in ("benchmarks", "datagen", "fusion") and not node.module.startswith("datagen.blender"):
                module = importlib.import_module(node.module)
                parts = {part.name for part in pkgutil.iter_modules(getattr(module, "__path__", []))}
                names = (alias.name for alias in node.names)
                missing += [f"{node.module}.{n}" for n in names if not hasattr(module, n) and n not in parts]
    assert missing == []


@pytest.mark.parametrize("path", BENCHMARKS, ids=[path.stem for path in BENCHMARKS])
def test_a_benchmark_can_be_imported_and_leaves_the_search_path_to_the_package(path):
    importlib.import_module(f"benchmarks.{path.stem}")
    assert path.name == "__init__.py" or "sys.path" not in path.read_text()


def test_a_benchmark_of_a_package_s_name_does_not_hide_the_package():
    command = [sys.executable, "-m", "benchmarks.fusion", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=CHECKOUT)
    assert (done.returncode, done.stderr) == (0, "")
    assert "python -m benchmarks.fusion DATASET" in done.stdout
