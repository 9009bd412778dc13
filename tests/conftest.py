"""What several test files share: one small run of the demonstration, and the folder of real scans.

Files of tests run side by side, one process for each core; those that look at the demonstration in one process, begun
first because it takes longest.
"""
import os
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:                      # processes do not take each other's cores
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from scanprep.console import run


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """One group for every file, and one for the files that share the demonstration."""
    shared = {item.path for item in items if "demo_folder" in item.fixturenames}
    for item in items:
        item.add_marker(pytest.mark.xdist_group("demo" if item.path in shared else item.path.name))
    items.sort(key=lambda item: item.path not in shared)


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory):
    """The folder of one `scape demo --quick`, run once for all tests that look at it."""
    from completion.cli import demo

    folder = tmp_path_factory.mktemp("demo") / "scape_demo"
    assert run(demo, "scape demo", ["--quick", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="session")
def real_data():
    """The folder of real scans, or the test is skipped."""
    folder = os.environ.get("SCAPEKIT_DATA")
    if not folder or not Path(folder, "scape_poses").is_dir():
        pytest.skip("SCAPEKIT_DATA does not name the folder of the real scans")
    return Path(folder)
