"""What several test files share: one small run of the demonstration, and the folder of real scans.

Files of tests run side by side, one process for each core.
"""
import os
import sys
import tempfile
import time
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:                      # processes do not take each other's cores
    # whoever was loaded before keeps all cores, and then sums otherwise than the commands that the tests start
    assert "numpy" not in sys.modules, "a plugin of pytest loads numpy: switch it off in pyproject.toml, as the others"
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.cpu_count = lambda: 1
    os.sched_getaffinity = lambda pid: {0}

from browser import browser, new_page, page  # noqa: F401 -- fixtures
from click_app import app, server  # noqa: F401 -- fixtures
from exclusive_writes import ExclusiveWrites

from scanprep.command_line import run

LONGEST = (
    "readme", "readme_scans", "readme_model", "readme_completion", "model_learning_resume",
    "completion_mosh_resume", "scanprep_pipeline_workers", "model_statue_cli",
    "demo", "model_coregistration_rounds", "model_statue_features", "scanprep_viewer_pick", "judgement",
    "scanprep_pipeline", "scanprep_registration_start", "model_coregistration", "model_learning_cli",
    "scanprep_skeleton_search", "scanprep_skeleton_find", "scanprep_template", "completion_stream",
    "scanprep_viewer_connection", "completion_viewing_inside", "completion_measuring", "scanprep_registration_nonrigid",
    "completion_viewing_models", "model_conformance", "model_animals", "completion_interactive",
    "completion_mosh_cli", "model_mixing", "scanprep_cli", "completion_tracking")
PLACE = {f"test_{name}.py": place for place, name in enumerate(LONGEST)}


def pytest_configure(config):
    """A folder for what all processes of this run make once, see `people_bodies`: their environment names it."""
    if "SCAPEKIT_TESTS" not in os.environ:
        shared = tempfile.TemporaryDirectory(prefix="scapekit_tests_")
        os.environ["SCAPEKIT_TESTS"] = shared.name
        config.add_cleanup(lambda: (os.environ.pop("SCAPEKIT_TESTS"), shared.cleanup()))


def pytest_collection_modifyitems(items):
    """The longest files first, so that all processes end at about the same time.

    `readme_model` and `demo` wait for the folder that `readme` makes first, so they are not at the very beginning.
    """
    items.sort(key=lambda item: PLACE.get(item.path.name, len(PLACE)))


@pytest.fixture(scope="session")
def listener():
    return ExclusiveWrites()


@pytest.fixture(autouse=True)
def exclusive_writes(listener):
    """Every file that scapekit writes in a test is one that it made itself, never one that was there, or a link."""
    listener.wrong.clear()
    yield listener
    assert not listener.wrong


@pytest.fixture(scope="session", autouse=True)
def run_folder(tmp_path_factory):
    """The folder that the processes of this run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def made_once(folder, make):
    """A folder that `make` fills once for all processes of this run; whoever comes later waits for it."""
    ended = folder.parent.with_name(f"{folder.name}.ended")
    try:
        folder.parent.mkdir()
    except FileExistsError:                                  # another process is at it
        while not ended.exists():
            time.sleep(0.5)
    else:
        code = None
        try:
            code = make()
        finally:
            ended.write_text(str(code))
    assert ended.read_text() == "0"
    return folder


@pytest.fixture(scope="session")
def demo_folder(run_folder):
    """The folder of one `scape demo --quick`, run once for all tests that look at it, in whatever process."""
    from quiet_pictures import coarse_pictures

    from completion.demo.cli import demo

    folder = run_folder / "demo" / "scape_demo"
    with coarse_pictures():
        return made_once(folder, lambda: run(demo, "scape demo", ["--quick", "--output", str(folder)]))


@pytest.fixture(scope="session")
def sample_folder(run_folder):
    """The folder of one `scape sample`, in which nothing is written."""
    from completion.demo.sample import write_sample

    folder = run_folder / "first_minute" / "sample"
    return made_once(folder, lambda: run(write_sample, "scape sample", ["--output", str(folder)]))


@pytest.fixture(scope="session")
def real_data():
    """The folder of real scans, or the test is skipped."""
    folder = os.environ.get("SCAPEKIT_DATA")
    if not folder or not Path(folder, "scape_poses").is_dir():
        pytest.skip("SCAPEKIT_DATA does not name the folder of the real scans")
    return Path(folder)
