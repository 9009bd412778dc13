"""One who works in a folder of `readme_folder`, and does not wait for what nobody looks at."""
from contextlib import contextmanager

import pytest
from people_bodies import small_people, with_sexes
from quiet_pictures import coarse_pictures

from model import files
from scanprep.batch.digests import Digests
from scanprep.registration import person

_on: dict[str, object] = {}


def once(find):
    """The average person on a template, sought once of all the commands that read the same one."""
    def found(template, tell):
        key = Digests().of(template.vertices, template.faces)
        if key not in _on:
            _on[key] = find(template, tell)
        return _on[key]

    return found


@contextmanager
def work_in(folder):
    """Work in a folder; pictures are small."""
    with pytest.MonkeyPatch.context() as here, coarse_pictures():
        here.chdir(folder)
        yield


@contextmanager
def of_a_user(folder):
    """Work in a folder; the model of those without one is small, and so are all pictures."""
    small, load_model = with_sexes(small_people()), files.load_model
    with pytest.MonkeyPatch.context() as here, work_in(folder):
        here.setattr(person, "_person_on", once(person._person_on))
        here.setattr(files, "load_model", lambda path: small if str(path) == files.BUILT_IN else load_model(path))
        yield
