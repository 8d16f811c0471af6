"""Comparisons with made-up results."""

from dataclasses import replace

import numpy as np

from rejoint.control.comparison.result import Protocol, collect, comparison_of, row_of


def made_comparison(arm, columns, targets):
    """A comparison of controllers whose ``columns`` (S, R, K) of results are given by name."""
    protocol, parts = Protocol(), {}
    for name, values in columns.items():
        shape = np.shape(values["crossed"])
        parts[name] = collect((), shape, protocol) | {"held": np.ones(shape), **values}
    rows = tuple(row_of(name, part, protocol) for name, part in parts.items())
    told = {"robot": "emulated:worn", "arm": arm.name, "seed": 0, "batched": True, "protocol": protocol, "rows": rows}
    return comparison_of(parts, targets, **told)


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
