"""Measurements against peers, by hand, from the checkout: ``python -m benchmarks.fusion --help``.

As scripts they would find their own folder first, whose ``fusion.py`` would hide the package that it measures.
"""

import sys
from pathlib import Path

# The analytic truths of the tests serve here, too. Last, as folders of the tests have the packages' names.
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
