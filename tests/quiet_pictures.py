"""Pictures that nobody looks at, for tests of commands that draw them."""
import numpy as np
import pytest

from scanprep.pictures import scene


def render(*_given, **_named):
    """In place of drawing a body, which would take most of the time."""
    return np.full((30, 20, 3), 255, dtype=np.uint8)


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """For the file that imports this."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "render", render)
        yield
