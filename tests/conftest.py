"""What several test files share: one small run of the demonstration, and the folder of real scans."""
import os
from pathlib import Path

import pytest

from scanprep.console import run


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
