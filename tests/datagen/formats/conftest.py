import pytest
from converted_datasets import write_source


@pytest.fixture
def source(tmp_path):
    """A dataset of ours: five frames around a sphere before a wall, the cameras rolled, with a true mesh."""
    return write_source(tmp_path / "source")
