"""One who works in a folder of `readme_folder`, and does not wait for what nobody looks at."""
from contextlib import contextmanager

import pytest
from people_bodies import small_people
from quiet_pictures import coarse_pictures

from completion import synthetic_people
from scanprep.batch.digests import Digests
from scanprep.registration import person

_on: dict[str, object] = {}


def once(find):
    """The average person on a template, sought once of all the commands that read the same one."""
    def found(template, landmarks, config, tell):
        key = Digests().of(template.vertices, template.faces, landmarks, config)
        if key not in _on:
            _on[key] = find(template, landmarks, config, tell)
        return _on[key]

    return found


@contextmanager
def of_a_user(folder):
    """Work in a folder, with a cache of its own; the model of those without one is small, and so are all pictures."""
    small = small_people()                                       # from the cache of the run
    with pytest.MonkeyPatch.context() as here, coarse_pictures():
        here.setattr(person, "_person_on", once(person._person_on))
        here.chdir(folder)
        here.setenv(synthetic_people.CACHE, str(folder / "cache"))
        here.setattr(synthetic_people, "build_synthetic", lambda recipe, progress: small)
        yield
