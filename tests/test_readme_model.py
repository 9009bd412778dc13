"""Every command and snippet of the README of `model` runs, on what the demonstration made."""
import shutil

import pytest
from readme_folder import blocks, run_commands, user_folder, with_demo_model
from readme_user import of_a_user

README = "model/README.md"
pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """The folder of a user who has a registered set and a model."""
    folder = with_demo_model(user_folder(demo_folder, tmp_path_factory.mktemp("readme")))
    shutil.copytree(demo_folder / "set", folder / "set", dirs_exist_ok=True)
    return folder


@pytest.fixture(autouse=True)
def there(place):
    """Work in that folder."""
    with of_a_user(place):
        yield


def test_commands():
    run_commands(README)


@pytest.mark.parametrize("code", blocks(README, "python"))
def test_snippets(code):
    if "import torch" in code:
        pytest.importorskip("torch")
    exec(compile(code, README, "exec"), {})
