"""Every command and snippet of the documents about range views and scans runs; see `test_readme.py`."""
import pytest
from readme_folder import commands_of_part, run_command, run_snippet, snippets_of_part, user_folder
from readme_user import of_a_user

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """The folder of a user who has scans, and a set that is not finished."""
    return user_folder(demo_folder, tmp_path_factory.mktemp("readme"))


@pytest.fixture(autouse=True)
def there(place):
    """Work in that folder."""
    with of_a_user(place):
        yield


def test_commands():
    lines = commands_of_part("scans")
    assert lines
    for line in lines:
        run_command(line)


@pytest.mark.parametrize("document, code", snippets_of_part("scans"))
def test_snippets(document, code):
    run_snippet(document, code)
