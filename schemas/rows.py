"""Normal form of table rows, so that what is written and read back equals what was given."""

from collections.abc import Mapping
from typing import Any

import pyarrow as pa


def normalize_row(row: Mapping[str, Any], schema: pa.Schema) -> dict[str, Any]:
    """Normalize a row: every column of its table in order, None for missing values, numbers of the column's type.

    Columns that the table does not have stay, behind the others: the writer of the row refuses them.
    """
    known = {field.name: _convert(row.get(field.name), field.type) for field in schema}
    return {**known, **{name: value for name, value in row.items() if name not in known}}


def _convert(value: Any, kind: pa.DataType) -> Any:
    if pa.types.is_floating(kind) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return list(value) if isinstance(value, tuple) else value
