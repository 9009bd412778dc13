"""Docstrings of the public names: every parameter, what comes back, and an example that runs."""
import doctest
import importlib
import inspect
import warnings

import numpy as np
import pytest
from numpydoc.docscrape import ClassDoc, FunctionDoc

PACKAGES = ("scanprep", "model", "completion")
NAMES = [(package, name) for package in PACKAGES for name in importlib.import_module(package).__all__]


def public(package, name):
    return getattr(importlib.import_module(package), name)


def documentation(found):
    return ClassDoc(found) if inspect.isclass(found) else FunctionDoc(found)


@pytest.mark.parametrize("package, name", NAMES)
def test_docstring_says_what_goes_in_and_comes_out(package, name):
    found = public(package, name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")                   # numpydoc warns of sections that it does not know
        text = documentation(found)
    summary = inspect.getdoc(found).split("\n")[0]
    assert summary.endswith("."), "one sentence first"
    if inspect.isfunction(found):
        asked = [p.name for p in inspect.signature(found).parameters.values()]
        told = [part.strip().lstrip("*") for one in text["Parameters"] for part in one.name.split(",")]
        assert told == asked
        assert text["Returns"] or text["Yields"] or inspect.signature(found).return_annotation in ("None", None)
        assert all(one.type for one in text["Parameters"]), "a type or a shape for every parameter"
    if not inspect.isclass(found) or not issubclass(found, Exception):
        assert ">>>" in found.__doc__, "an example"


@pytest.mark.parametrize("package, name", NAMES)
def test_example_runs(package, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = public(package, name)
    # of a class all methods too; an example may use numpy and the public names, all else it imports itself
    known = {"np": np, **{one: public(where, one) for where, one in NAMES}}
    for test in doctest.DocTestFinder(exclude_empty=True, recurse=True).find(found, name, globs=known):
        if test.examples:
            result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(test)
            assert not result.failed, test.name
