"""The results of an experiment as Parquet, where pyarrow is installed."""

import importlib
from pathlib import Path

from trompe_shared.errors import SpecError
from trompe_shared.experiment_table import RESULTS, ResultRow, read_table

__all__ = ["write_parquet"]


def write_parquet(folder: Path) -> Path:
    """Write ``results.parquet`` beside ``results.csv``; gives its path. Raises ``SpecError`` without pyarrow."""
    try:
        arrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError as error:
        raise SpecError(f"Parquet needs pyarrow: pip install 'trompe[report]' ({error}).") from error
    rows = [row.model_dump() for row in read_table(folder / RESULTS, ResultRow)]
    kinds = {"bool": arrow.bool_(), "int": arrow.int64(), "float": arrow.float64()}
    fields = [
        (name, next((kind for word, kind in kinds.items() if word in str(field.annotation)), arrow.string()))
        for name, field in ResultRow.model_fields.items()
    ]
    path = folder / "results.parquet"
    parquet.write_table(arrow.Table.from_pylist(rows, schema=arrow.schema(fields)), path)
    return path
