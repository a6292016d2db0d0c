"""Independent programs that tests compare with; a test skips where one is not installed."""

import importlib
import warnings

import pytest

EXTRAS = {"evo.tools.file_interface": "dev", "pycolmap": "dev"}


def oracle(module):
    """Import a program's module, whatever it warns of while it is imported."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module(module)
    except ImportError as error:
        extra = EXTRAS.get(module, "oracles")
        pytest.skip(f'{module} cannot be imported ({error}): pip install "scanback[{extra}]"')
