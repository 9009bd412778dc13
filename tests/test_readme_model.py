"""Every command and snippet of the documents about models runs; see `test_readme.py`."""
import pytest
from readme_folder import (
    commands_of_part,
    keep_scans,
    run_command,
    run_snippet,
    snippets_of_part,
    user_folder,
    with_demo_model,
)
from readme_user import of_a_user

SCANS = ["subject_00_rest", "subject_01_kick_left", "person_00_female"]              # of one folder: two people
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """The folder of a user who has a registered set and a model."""
    folder = with_demo_model(user_folder(demo_folder, tmp_path_factory.mktemp("readme")))
    keep_scans(folder, SCANS)
    return folder


@pytest.fixture(autouse=True)
def there(place):
    """Work in that folder."""
    with of_a_user(place):
        yield


def test_commands():
    lines = commands_of_part("model")
    assert lines
    for line in lines:
        run_command(line)


@pytest.mark.parametrize("document, code", snippets_of_part("model"))
def test_snippets(document, code):
    run_snippet(document, code)
