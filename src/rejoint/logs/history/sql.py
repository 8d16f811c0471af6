"""SQL over the summary rows of a folder, by DuckDB."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.logs.history.index import find_table
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.extras import require

if TYPE_CHECKING:
    import duckdb


_ZONED = "TIMESTAMP WITH TIME ZONE"


def ask(
    folder: Path, query: str, left_out: Callable[[str], object] = lambda _: None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Answer a query over the table ``history``: column names, and rows.

    Columns as `HistoryRow`, UTC. ``left_out`` receives damaged files. The query cannot read or write files. InputError
    for a wrong query, FileError without rows, MissingExtraError without DuckDB.
    """
    require("rejoint history --sql", "history")
    import duckdb

    table, problems = find_table(folder)
    for problem in problems:
        left_out(problem)
    if not len(table):
        raise FileError(folder, "no run and no check has left rows here", "check an arm first: rejoint check ROBOT")
    with duckdb.connect() as connection:
        connection.from_arrow(table).to_table("history")
        connection.execute("set enable_external_access = false")
        connection.execute("set TimeZone = 'UTC'")  # as rows have it: now() would be off by the zone of this place
        connection.execute("set lock_configuration = true")  # its log into a file would end this process
        connection.execute("begin transaction read only")  # else it tells that rows were deleted, and they are not
        with ThreadPoolExecutor(1) as pool:  # DuckDB hears no signal while it is at work
            answer = pool.submit(_answer, connection, query)
            try:
                return answer.result()
            except duckdb.Error as error:
                raise InputError(f"--sql: {first_line(error)}") from error
            except BaseException:
                connection.interrupt()
                raise


def _answer(connection: duckdb.DuckDBPyConnection, query: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    found = connection.sql(query)
    if found is None:
        raise InputError("--sql: expected a query that answers with rows")
    return found.columns, _without_zones(found).fetchall()


def _without_zones(found: duckdb.DuckDBPyRelation) -> duckdb.DuckDBPyRelation:
    """Return times without zones, which would need another package."""
    if all(str(kind) != _ZONED for kind in found.types):
        return found
    columns = (
        f"#{number}" + "::timestamp" * (str(kind) == _ZONED) + ' as "{}"'.format(name.replace('"', '""'))
        for number, (name, kind) in enumerate(zip(found.columns, found.types, strict=True), start=1)
    )
    return found.project(", ".join(columns))
