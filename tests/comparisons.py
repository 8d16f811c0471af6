"""Comparisons with made-up results."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from rejoint.control.comparison.protocols import Tally, comparison_of
from rejoint.control.comparison.result import Protocol


def made_comparison(arm, columns, targets, protocol=None, robot="emulated:worn", **facts):
    """A comparison of controllers whose ``columns`` (S, R, K) of results are given by name."""
    protocol, tallies = protocol or Protocol(), {}
    for name, values in columns.items():
        shape = np.shape(values["crossed"])
        tallies[name] = Tally(shape, protocol)
        tallies[name].columns |= {"held": np.ones(shape), **values}
        tallies[name].cycles = 1000
    found = comparison_of(SimpleNamespace(address=robot, arm=arm), 0, True, np.asarray(targets, dtype=float), tallies)
    return replace(found, **facts)


def refilled(found, controller, **columns):
    """The comparison with other results of one controller; its row of statistics stays."""
    results = dict(found.results)
    for name, values in columns.items():
        index = found.controllers.index(controller)
        table = np.array(results[name], dtype=object).reshape(len(found.rows), -1)
        table[index] = np.ravel(values)
        results[name] = tuple(table.ravel().tolist())
    return replace(found, results=results)


def picked(found, names):
    """The comparison of some of its controllers, under other ``names``: new name by old one."""
    where = [found.controllers.index(name) for name in names]
    rows = tuple(replace(found.row(old), controller=new) for old, new in names.items())
    results = {
        key: tuple(np.array(values, dtype=object).reshape(len(found.rows), -1)[where].ravel().tolist())
        for key, values in found.results.items()
    }
    return replace(found, rows=rows, results=results)
