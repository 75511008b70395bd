"""Rows of tables in one form, so that what was written and read back is what was given."""

from collections.abc import Mapping
from typing import Any

import pyarrow as pa


def normalize_row(row: Mapping[str, Any], schema: pa.Schema) -> dict[str, Any]:
    """The row with every column of its table, in their order; what it lacks is None, and numbers are of their kind.

    Columns that the table does not have stay, behind the others: whoever writes the row refuses them.
    """
    known = {field.name: _of_kind(row.get(field.name), field.type) for field in schema}
    return {**known, **{name: value for name, value in row.items() if name not in known}}


def _of_kind(value: Any, kind: pa.DataType) -> Any:
    if pa.types.is_floating(kind) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return list(value) if isinstance(value, tuple) else value
