import os
import sys

import hypothesis
import pytest

# Speed is measured in benchmarks/; here a busy machine must not fail a law.
hypothesis.settings.register_profile("laws", deadline=None)
hypothesis.settings.load_profile("laws")

_SESSION = pytest.StashKey[pytest.Session]()


def pytest_sessionstart(session: pytest.Session) -> None:
    session.config.stash[_SESSION] = session


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End here, all reported, with Blender 4.5: as a module it may wait for a thread of its own for ever."""
    blender = sys.modules.get("bpy")
    if blender is None or blender.app.version >= (5, 0) or hasattr(config, "workerinput"):
        return
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(config.stash[_SESSION].exitstatus)
