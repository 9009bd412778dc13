"""Pictures that nobody looks at, for tests of commands that draw them."""
from contextlib import contextmanager

import numpy as np
import pytest

from completion import motion_pictures
from scanprep.pictures import scene, shading
from scanprep.pipeline import page


def render(*_given, **_named):
    """In place of drawing a body, which would take most of the time."""
    return np.full((30, 20, 3), 255, dtype=np.uint8)


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """For the file that imports this."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "render", render)
        yield


def coarse(shapes, camera, width, height):
    """Drawn as always, with a quarter of the pixels each way."""
    return shading.render(shapes, camera, width // 4, height // 4)


@contextmanager
def coarse_pictures():
    """Everything that draws bodies draws few pixels."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (scene, page, motion_pictures):
            patch.setattr(module, "render", coarse)
        yield
