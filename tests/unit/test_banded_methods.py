"""Which code solves the windows of `smoother-banded`."""

import sys

import pytest

from fgtrack.estimation import banded
from fgtrack.estimation.banded import methods


def test_without_numba_it_is_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods, "find_spec", lambda name: None)
    assert methods.fastest.__wrapped__() is methods.IN_NUMPY


def test_a_numba_that_fails_is_named_and_numpy_takes_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "fgtrack.estimation.banded.compiled", None)
    monkeypatch.delattr(banded, "compiled", raising=False)
    with pytest.warns(RuntimeWarning, match="smoother-banded runs without numba, which fails: "):
        assert methods.fastest.__wrapped__() is methods.IN_NUMPY


def test_with_numba_it_is_compiled() -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install fgtrack[fast]")
    assert methods.fastest() is methods.fastest() is not methods.IN_NUMPY
