"""What several test files share: one small run of the demonstration, and the folder of real scans.

Files of tests run side by side, one process for each core.
"""
import os
import time
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:                      # processes do not take each other's cores
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from browser import browser, new_page, page  # noqa: F401 -- fixtures
from click_app import app, server  # noqa: F401 -- fixtures

from scanprep.command_line import run


def pytest_collection_modifyitems(items):
    """The longest files first, so that the other processes have enough to do beside them."""
    items.sort(key=lambda item: not item.path.name.startswith("test_readme"))


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory):
    """The folder of one `scape demo --quick`, run once for all tests that look at it, in whatever process."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, ended = base / "demo" / "scape_demo", base / "demo.ended"
    try:
        folder.parent.mkdir()
    except FileExistsError:                                  # another process is at it
        while not ended.exists():
            time.sleep(0.5)
    else:
        from completion.demo.cli import demo

        code = None
        try:
            code = run(demo, "scape demo", ["--quick", "--out", str(folder)])
        finally:
            ended.write_text(str(code))
    assert ended.read_text() == "0"
    return folder


@pytest.fixture(scope="session")
def real_data():
    """The folder of real scans, or the test is skipped."""
    folder = os.environ.get("SCAPEKIT_DATA")
    if not folder or not Path(folder, "scape_poses").is_dir():
        pytest.skip("SCAPEKIT_DATA does not name the folder of the real scans")
    return Path(folder)
