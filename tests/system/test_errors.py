"""Errors with names travel between processes."""

import inspect
import pickle

import pytest

from rejoint.system import errors
from rejoint.system.stopping import Interrupted

FILE = errors.FileError("a.parquet", "damaged", "record it again")
NAMED = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.RejointError)]
MADE = {
    errors.FileError: FILE,
    errors.UnsavedError: errors.UnsavedError(FILE, {"reached": 3}),
    errors.GuardTripError: errors.GuardTripError("floor", "too low"),
}


@pytest.mark.parametrize(
    "error",
    [*(MADE.get(kind) or kind("what was found") for kind in NAMED), Interrupted(2), Interrupted(2, "a button")],
    ids=repr,
)
def test_an_error_comes_out_of_another_process_as_it_was(error):
    error.add_note("the arm holds")
    came = pickle.loads(pickle.dumps(error))
    assert (type(came), str(came), vars(came).keys()) == (type(error), str(error), vars(error).keys())
    assert came.__notes__ == error.__notes__
    assert repr(came) == repr(error)
